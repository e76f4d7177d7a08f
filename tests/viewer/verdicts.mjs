// Questions, verdicts and what a change did in the viewer, by mouse and by keyboard.

import assert from "node:assert/strict";
import { colours, coseg, select, shown, toast } from "./page.mjs";

const C = "chairs";

const of = (name) => coseg("labels", name, "--collection", C).labels;
const inState = (state) => coseg("ls", C, "--review", state).shapes.map((s) => s.name);
const review = (name) => coseg("show", name, "--collection", C).review;
const settled = () => coseg("wait", "--collection", C);
/** The number that the page shows beside a verdict. */
const counted = (page, state) =>
  page.$eval(`[data-review=${state}] .n`, (n) => Number(n.textContent));

/** Waits until the page counts as many shapes with a verdict as the daemon. */
async function agrees(page, state, n) {
  assert.equal(inState(state).length, n, state);
  await page.waitForFunction(
    ([state, n]) => document.querySelector(`[data-review=${state}] .n`).textContent === String(n),
    [state, n],
  );
}

export async function verdictTests({ test, open, shot, url, names }) {
  const [first, second, third] = names;
  const finish = async (page) => {
    assert.deepEqual(page.faults, []);
    await page.context().close();
  };

  await test("questions are answered, undone and redone by keys", async () => {
    const page = await open(`${url}#${C}`);
    const before = of(first);
    const question = () => page.$eval("#controls", (c) => c.textContent);
    await page.keyboard.press("q");
    await page.waitForFunction(() =>
      document.querySelector("#controls")?.textContent.includes("0 answered"),
    );
    const asked = new URL(page.url()).hash.split("/")[1];
    await shown(page, asked, "ask");
    assert.ok((await colours(page, "#scene")) > 2);
    await shot(page, "question");
    const offered = await page.$$eval(".palette [data-answer]", (all) => all.length);
    assert.ok(offered >= 1 && offered <= 3, await question());
    // Does something that answers, and waits for another question.
    const next = async (act) => {
      const was = await page.$eval("#controls", (c) => c.dataset.question);
      await act();
      await page.waitForFunction(
        (was) => document.querySelector("#controls").dataset.question !== was,
        was,
      );
    };
    await page.keyboard.press("n");
    await page.keyboard.type("seat");
    await next(() => page.keyboard.press("Enter"));
    assert.match(await question(), /1 answered/);
    const seat = coseg("show", "--collection", C).labels.find((l) => l.name === "seat").id;
    assert.ok(coseg("labels", asked, "--collection", C, "--no-wait").labels.includes(seat));
    assert.deepEqual(inState("corrected"), [asked]);
    // Where the shape has the focus, letters answer as well.
    await page.focus("#scene");
    await next(() => page.keyboard.press("s"));
    assert.match(await question(), /1 answered/);
    await next(() => page.click("[data-answer='1']"));
    assert.match(await question(), /2 answered/);
    await page.waitForSelector("#effect:not([hidden])");
    for (const [keys, word, n] of [
      ["Control+z", "Undone: the answer", 1],
      ["Control+Shift+z", "Redone: the answer", 2],
      ["Control+z", "Undone: the answer", 1],
      ["Control+z", "Undone: the answer", 0],
    ]) {
      await page.keyboard.press(keys);
      await toast(page, word);
      assert.ok(inState("corrected").length <= n, `${keys}: ${inState("corrected")}`);
    }
    settled();
    assert.deepEqual(of(first), before);
    await finish(page);
  });

  for (const way of ["mouse", "keyboard"])
    await test(`a person with a name approves and doubts shapes: by ${way}`, async () => {
      const page = await open(`${url}#${C}`);
      await page.fill("#reviewer", "Ada");
      await page.keyboard.press("Enter");
      const unseen = inState("unseen").length;
      assert.equal(await counted(page, "unseen"), unseen);
      await page.focus(`.card[data-name="${first}"]`);
      await page.keyboard.press("Enter");
      await shown(page, first, "labels");
      await page.keyboard.press("ArrowRight");
      await shown(page, second, "labels");
      const press = (id, key) => (way === "mouse" ? page.click(id) : page.keyboard.press(key));
      await press("#approve", "y");
      await toast(page, `${second} is approved`);
      assert.deepEqual([review(second).state, review(second).by], ["approved", "Ada"]);
      await page.waitForFunction(() =>
        /^Approved by Ada, \d/.test(document.querySelector("#verdict")?.textContent),
      );
      assert.match(await page.textContent(`.card[data-name="${second}"]`), /approved.*Ada, \d/);
      settled();
      await press("#next", "ArrowRight");
      await shown(page, third, "labels");
      await press("#doubtful", "u");
      await toast(page, `${third} is doubtful`);
      assert.deepEqual([review(third).state, review(third).by], ["doubtful", "Ada"]);
      assert.ok(
        (await page.isHidden("#effect")) || !(await page.textContent("#effect")).includes("doubt"),
      );
      await agrees(page, "approved", 1);
      await agrees(page, "doubtful", 1);
      await agrees(page, "unseen", unseen - 2);
      for (const [state, name] of [
        ["approved", second],
        ["doubtful", third],
      ]) {
        if (way === "mouse") await page.click(`[data-review=${state}]`);
        else {
          await page.focus(`[data-review=${state}]`);
          await page.keyboard.press("Space");
        }
        await page.waitForFunction(() => document.querySelectorAll(".card").length === 1);
        assert.equal(await page.getAttribute(".card", "data-name"), name);
        assert.match(await page.textContent("#count"), /1 of \d+ shapes/);
        assert.ok(page.url().includes(`review=${state}`));
      }
      await page.keyboard.press("Escape");
      await shot(page, `doubtful-${way}`);
      await page.click("[data-review=doubtful]");
      await page.waitForFunction(
        (n) => document.querySelectorAll(".card").length === n,
        names.length,
      );
      assert.equal(await page.inputValue("#reviewer"), "Ada");
      for (const [name, word] of [
        [third, "doubt"],
        [second, "approval"],
      ]) {
        await press("#undo", "Control+z");
        await toast(page, `Undone: the ${word} of ${name}.`);
      }
      for (const state of ["approved", "doubtful"]) await agrees(page, state, 0);
      settled();
      await finish(page);
    });

  for (const way of ["mouse", "keyboard"])
    await test(`what a change moved, first and as it was before: by ${way}`, async () => {
      const page = await open(`${url}#${C}`);
      const press = async (id, key) => {
        if (way === "mouse") return page.click(id);
        if (key) return page.keyboard.press(key);
        await page.focus(id);
        return page.keyboard.press("Enter");
      };
      const since = coseg("show", "--collection", C).sequence;
      const before = new Map(names.map((name) => [name, of(name)]));
      await press("#suggest", "g");
      const suggested = coseg("suggest", "--collection", C).shape;
      await shown(page, suggested, "correct");
      await toast(page, `${suggested}: `);
      // Its largest part has a label that no shape had.
      await page.click(".palette button:last-child");
      await page.click(".part");
      await press("#apply", await page.focus("#scene").then(() => "Enter"));
      await toast(page, "");
      settled();
      await page.waitForFunction(() => {
        const { textContent } = document.querySelector("#effect");
        return textContent && !textContent.includes("still to come");
      });
      const changed = names.filter((name) => of(name).some((l, f) => l !== before.get(name)[f]));
      assert.ok(changed.includes(suggested));
      const effect = await page.textContent("#effect");
      const [, share, n] = /changed ([\d.]+) % of all area, on (\d+) of/.exec(effect);
      // Some shapes may have changed and come back.
      assert.ok(Number(n) >= changed.length && Number(share) > 0, `${effect} ${changed}`);
      const moved = coseg("events", "--collection", C, "--since", String(since));
      assert.ok(JSON.stringify(moved).includes(suggested));
      await press("#moved-first");
      await page.waitForFunction(() => location.hash.includes("order=moved"));
      const cards = await page.$$eval(".card", (all) =>
        all.map((c) => [c.dataset.name, c.textContent]),
      );
      assert.ok(changed.includes(cards[0][0]), `${cards[0][0]} is the first`);
      assert.match(cards[0][1], /± (< )?[\d.]+ %/);
      const canvas = `.card[data-name="${suggested}"] canvas`;
      await page.locator(canvas).scrollIntoViewIfNeeded();
      await page.waitForSelector(`${canvas}[data-drawn]`);
      const pictures = () =>
        page.evaluate(
          (c) => [c, "#scene"].map((s) => document.querySelector(s).toDataURL()),
          canvas,
        );
      const drawn = async () => {
        await page.waitForTimeout(400);
        return pictures();
      };
      const after = await drawn();
      await shot(page, `after-${way}`);
      await press("#before", "v");
      const past = await drawn();
      assert.ok(
        past[0] !== after[0] && past[1] !== after[1],
        "the card and the stage show what was before",
      );
      assert.match(await page.textContent("#captions"), /before the last change/);
      await shot(page, `before-${way}`);
      await press("#before", "v");
      const again = await drawn();
      assert.ok(again[0] === after[0], "the card shows the present labels again");
      assert.ok(
        await page.evaluate(() =>
          document.querySelector("#captions").textContent.includes("as sent"),
        ),
      );
      await press("#undo", "Control+z");
      await toast(page, "Undone: the correction");
      settled();
      for (const name of names) assert.deepEqual(of(name), before.get(name));
      await page.click("#effect-close");
      assert.ok(await page.isHidden("#effect"));
      await finish(page);
    });

  await test("beside a shape, approving waits until what is painted is sent", async () => {
    const page = await open(`${url}#${C}`);
    await select(page, first);
    await page.click("[data-mode=correct]");
    await shown(page, first, "correct");
    await page.click(".part");
    await page.click("#approve");
    await toast(page, "Apply or discard");
    assert.equal(review(first).state, "unseen");
    await page.click("#discard");
    await finish(page);
  });
}
