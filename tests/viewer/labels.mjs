// Labels are renamed, merged and split in the viewer, by mouse and by keyboard; the daemon says
// what became of them.

import assert from "node:assert/strict";
import { violations } from "./access.mjs";
import { coseg, shown, toast } from "./page.mjs";

const C = "candelabras";

const labels = () => coseg("show", "--collection", C).labels;
const inUse = () => labels().filter((l) => l.n_shapes > 0);
const label = (id) => labels().find((l) => l.id === id);
const settled = () => coseg("wait", "--collection", C);

/** The labels of every face of every shape. */
function everything() {
  const names = coseg("ls", "--collection", C).shapes.map((s) => s.name);
  return names.map((name) => [name, coseg("labels", name, "--collection", C).labels]);
}

/** How many shapes have a label, counted from their faces. */
const having = (all, id) => all.filter(([, of]) => of.includes(id)).length;

const editing = (page) => page.waitForSelector("#editor:not([hidden])");
const edited = (page) => page.waitForSelector("#editor", { state: "hidden" });
const pencil = (id) => `#legend [data-label="${id}"] .pencil`;
const focus = (page) =>
  page.evaluate(() => document.activeElement.id || document.activeElement.className);
const picture = (page) => page.$eval(".card canvas", (canvas) => canvas.toDataURL());

/** Presses Tab until a control has the focus. */
async function tabTo(page, id) {
  for (let i = 0; i < 12 && (await focus(page)) !== id; i++) await page.keyboard.press("Tab");
  assert.equal(await focus(page), id);
}

/** Undoes, does again and undoes a change by keys; `is` is checked each time at the daemon. */
async function backAndForth(page, noun, is, isNot) {
  for (const [keys, word, check] of [
    ["Control+z", "Undone: ", isNot],
    ["Control+Shift+z", "Redone: ", is],
    ["Control+z", "Undone: ", isNot],
  ]) {
    await page.keyboard.press(keys);
    await toast(page, `${word}${noun}`);
    settled();
    check();
  }
}

export async function labelTests({ test, open, shot, url }) {
  const finish = async (page) => {
    assert.deepEqual(page.faults, []);
    await page.context().close();
  };

  for (const way of ["mouse", "keyboard"])
    await test(`a label is renamed, and its name taken back: by ${way}`, async () => {
      const page = await open(`${url}#${C}`);
      const { id } = inUse()[0];
      const isNamed = (name) => assert.equal(label(id).name, name);
      if (way === "mouse") {
        await page.click(pencil(id));
        await editing(page);
        assert.ok(await page.isDisabled("#label-rename"), "nothing was typed");
        await page.fill("#label-name", "arm <b>&");
        await page.click("#label-rename");
      } else {
        await page.focus(pencil(id));
        await page.keyboard.press("Enter");
        await editing(page);
        assert.equal(await focus(page), "label-name");
        await page.keyboard.type("arm <b>&");
        await page.keyboard.press("Enter");
      }
      await edited(page);
      await toast(page, "“label");
      await page.waitForFunction(
        (id) => document.querySelector(`[data-label="${id}"] .text`)?.textContent === "arm <b>&",
        id,
      );
      isNamed("arm <b>&");
      assert.equal(await focus(page), "pencil", "the focus returns to the label");
      assert.ok(await page.isHidden("#effect"), "a name moves no label");
      await backAndForth(
        page,
        "the name “arm <b>&”",
        () => isNamed("arm <b>&"),
        () => isNamed(null),
      );
      await finish(page);
    });

  await test("a name of another label leads to a merge, and a refusal is shown", async () => {
    const page = await open(`${url}#${C}`);
    const [{ id }, { id: other }] = inUse();
    coseg("name", String(other), "foot", "--collection", C);
    await page.waitForFunction(
      (id) => /foot/.test(document.querySelector(`[data-label="${id}"]`).textContent),
      other,
    );
    await page.click(pencil(id));
    await page.fill("#label-name", "foot");
    assert.match(await page.textContent("#label-rename-effect"), /called “foot”: merge/);
    assert.ok(await page.isDisabled("#label-rename"));
    await page.fill("#label-name", "arm/foot");
    await page.click("#label-rename");
    await page.waitForFunction(() =>
      /has '\/'/.test(document.querySelector("#editor .error").textContent),
    );
    await shot(page, "refused");
    assert.equal(label(id).name, null);
    await page.keyboard.press("Escape");
    await edited(page);
    coseg("undo", "--collection", C);
    // The browser notes the refusal as well.
    page.faults = page.faults.filter((fault) => !/status of 400/.test(fault));
    await finish(page);
  });

  for (const way of ["mouse", "keyboard"])
    await test(`two labels become one, after the page showed the change: by ${way}`, async () => {
      const page = await open(`${url}#${C}`);
      const before = everything();
      const [into, from] = inUse().map((l) => l.id);
      const n = having(before, from);
      if (way === "mouse") {
        await page.click(pencil(from));
      } else {
        await page.focus(pencil(from));
        await page.keyboard.press("Enter");
      }
      await editing(page);
      await page.waitForFunction((n) => document.querySelectorAll(".card").length === n, n);
      assert.ok(await page.isDisabled("#label-merge"), "no other label is chosen");
      const alone = await picture(page);
      if (way === "mouse") await page.selectOption("#label-into", String(into));
      else {
        await tabTo(page, "label-into");
        await page.keyboard.press("ArrowDown");
        assert.equal(await page.inputValue("#label-into"), String(into));
      }
      const text = await page.textContent("#label-merge-effect");
      assert.match(text, new RegExp(`^${n} shapes? will change: [\\d.]+ % of all area becomes`));
      await page.waitForFunction(
        (was) => document.querySelector(".card canvas").toDataURL() !== was,
        alone,
      );
      await shot(page, `merge-${way}`);
      assert.deepEqual(everything(), before, "nothing is changed yet");
      if (way === "mouse") await page.click("#label-merge");
      else {
        await tabTo(page, "label-merge");
        await page.keyboard.press("Enter");
      }
      await edited(page);
      await toast(page, "“label");
      const merged = before.map(([name, of]) => [name, of.map((l) => (l === from ? into : l))]);
      const isMerged = () => {
        assert.deepEqual(everything(), merged);
        assert.equal(label(from).merged_into, into);
      };
      settled();
      isMerged();
      assert.equal(await page.locator(pencil(from)).count(), 0);
      await page.waitForFunction(
        (n) => document.querySelector("#effect").textContent.includes(`on ${n} of`),
        n,
      );
      await shot(page, `merged-${way}`);
      await backAndForth(page, "the merge of", isMerged, () =>
        assert.deepEqual(everything(), before),
      );
      await finish(page);
    });

  for (const way of ["mouse", "keyboard"])
    await test(`a label is split in two, and becomes one again: by ${way}`, async () => {
      const page = await open(`${url}#${C}`);
      const before = everything();
      const [{ id }] = inUse();
      const known = labels().map((l) => l.id);
      if (way === "mouse") {
        await page.click(pencil(id));
        await editing(page);
        assert.match(
          await page.textContent("#label-split-effect"),
          new RegExp(`up to ${having(before, id)} shapes?`),
        );
        await shot(page, "split");
        await page.click("#label-split");
      } else {
        await page.click(`#legend [data-label="${id}"] .choose`);
        await page.keyboard.press("l");
        await editing(page);
        await tabTo(page, "label-split");
        await page.keyboard.press("Enter");
      }
      await edited(page);
      await toast(page, "A part of");
      const fresh = () => labels().filter((l) => !known.includes(l.id) && l.n_shapes > 0);
      const isSplit = () => {
        settled();
        assert.equal(fresh().length, 1, JSON.stringify(labels()));
        const after = everything();
        assert.ok(having(after, fresh()[0].id) > 0 && having(after, id) > 0);
      };
      isSplit();
      const [{ id: made }] = fresh();
      await page.waitForSelector(pencil(made));
      await backAndForth(page, "the split of", isSplit, () =>
        assert.deepEqual(everything(), before),
      );
      await finish(page);
    });

  await test("a change of a label that a split made is redone after the split", async () => {
    const page = await open(`${url}#${C}`);
    const known = labels().map((l) => l.id);
    const before = everything();
    const fresh = () => labels().filter((l) => !known.includes(l.id) && l.n_shapes > 0);
    await page.click(pencil(inUse()[0].id));
    await page.click("#label-split");
    await edited(page);
    const [{ id: made }] = fresh();
    await page.click(pencil(made));
    await page.fill("#label-name", "other half");
    await page.keyboard.press("Enter");
    await edited(page);
    for (let i = 0; i < 2; i++) {
      await page.keyboard.press("Control+z");
      await toast(page, "Undone: ");
    }
    settled();
    assert.deepEqual(everything(), before);
    await page.waitForSelector("#redo:enabled");
    await page.click("#redo");
    await toast(page, "Redone: the split");
    await page.click("#redo");
    await toast(page, "Redone: the name");
    settled();
    assert.equal(fresh().length, 1);
    assert.equal(fresh()[0].name, "other half");
    assert.notEqual(fresh()[0].id, made, "ids are not used again");
    for (let i = 0; i < 2; i++) {
      await page.click("#undo");
      await toast(page, "Undone: ");
    }
    settled();
    assert.deepEqual(everything(), before);
    await finish(page);
  });

  await test("the editor of a label and the list of keys keep nobody out", async () => {
    for (const size of [{}, { theme: "dark" }, { width: 420, height: 860 }]) {
      const page = await open(`${url}#${C}`, size);
      await page.keyboard.press("l");
      await editing(page);
      await page.selectOption("#label-into", { index: 1 });
      assert.deepEqual(await violations(page), [], `editor ${JSON.stringify(size)}`);
      const width = await page.$eval("body", (b) => b.scrollWidth);
      assert.ok(width <= (size.width ?? 1440), `the page is ${width} pixels wide`);
      await shot(page, `editor-${size.theme ?? size.width ?? "light"}`);
      await page.keyboard.press("Escape");
      await edited(page);
      await page.keyboard.press("?");
      await page.waitForSelector("#keys[open]");
      assert.deepEqual(await violations(page), [], `keys ${JSON.stringify(size)}`);
      await shot(page, `keys-${size.theme ?? size.width ?? "light"}`);
      await page.keyboard.press("Escape");
      await page.waitForSelector("#keys", { state: "hidden" });
      const name = coseg("ls", "--collection", C).shapes[0].name;
      await page.goto(`${url}#${C}/${name}/ask`);
      await shown(page, name, "ask");
      await page.keyboard.press("q");
      await page.waitForSelector("#ask-name");
      assert.deepEqual(await violations(page), [], `questions ${JSON.stringify(size)}`);
      await finish(page);
    }
  });
}
