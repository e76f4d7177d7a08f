// Proposals are compared and chosen, and parts are linked, by mouse and by keyboard; the daemon
// says what became of the labels.

import assert from "node:assert/strict";
import { violations } from "./access.mjs";
import { colours, coseg, select, shown, toast } from "./page.mjs";

const C = "candelabras";
/** A collection that has too few shapes for proposals. */
const PAIR = "pair";
const SIZES = [{}, { theme: "dark" }, { width: 420, height: 860 }];

const names = () => coseg("ls", "--collection", C).shapes.map((s) => s.name);
const of = (name) => coseg("labels", name, "--collection", C).labels;
const everything = () => names().map((name) => [name, of(name)]);
const settled = () => coseg("wait", "--collection", C);
/** The proposals, once they are made. */
const proposals = () => coseg("proposals", C);
const links = () => coseg("links", C).links;
const parts = (name) => coseg("show", name, "--collection", C).parts;
const refusal = (fault) => /status of 409/.test(fault);

const made = (page, set) => page.waitForSelector(`#proposals[data-ready="${set}"]`);
const card = (n) => `.division[data-n="${n}"]`;
const text = (page, selector) => page.$eval(selector, (e) => e.textContent);
const pictures = (page, selector) =>
  page.$$eval(`${selector} canvas`, (all) => all.map((canvas) => canvas.toDataURL()));

/** Moves the mouse over the shape until the page says that this part is there. */
async function over(page, part) {
  const box = await page.locator("#scene").boundingBox();
  for (let y = 0.1; y < 0.95; y += 0.04)
    for (let x = 0.1; x < 0.95; x += 0.04) {
      const at = [box.x + x * box.width, box.y + y * box.height];
      await page.mouse.move(...at);
      const hint = await page.$eval("#hint", (e) => (e.hidden ? "" : e.textContent));
      if (hint.startsWith(`${part},`)) return at;
    }
  assert.fail(`${part} is nowhere on the shape`);
}

async function proposalTests({ test, open, shot, url, finish }) {
  for (const way of ["mouse", "keyboard"])
    await test(`a proposal is looked at, chosen and taken back: by ${way}`, async () => {
      const { set, proposals: all } = proposals();
      const before = everything();
      const page = await open(`${url}#${C}`);
      if (way === "mouse") await page.click("#propose");
      else await page.keyboard.press("p");
      await made(page, set);
      assert.ok(await page.isHidden("#gallery"));
      // The labels in force are among them.
      const isAmong = all.some((p) => p.in_force);
      const n = all.length + (isAmong ? 0 : 1);
      assert.equal(await page.$$eval(".division", (cards) => cards.length), n);
      const inForce = await page.$$eval(".division", (cards) =>
        cards.filter((c) => c.textContent.includes("in force")).map((c) => c.dataset.n),
      );
      assert.deepEqual(inForce, [String(all.find((p) => p.in_force)?.n ?? 0)]);
      for (const p of all) {
        const facts = await text(page, card(p.n));
        assert.ok(facts.includes(`${p.n_labels} labels`), facts);
        assert.ok(facts.includes(`value ${p.value.toFixed(2)}`), facts);
        const how = p.in_force ? "in force" : `differs ${p.differs.toFixed(2)}`;
        assert.ok(facts.includes(how), `${facts}: ${how}`);
        assert.ok((await colours(page, `${card(p.n)} canvas`)) > 4);
      }
      const [coarse, fine] = [all[0], all.at(-1)];
      assert.notDeepEqual(await pictures(page, card(coarse.n)), await pictures(page, card(fine.n)));
      const wanted = [...all].sort((a, b) => b.differs - a.differs)[0];
      const large = await pictures(page, ".large");
      if (way === "mouse") {
        const ends = await page.$$eval(".division", (cards) => cards.map((c) => c.dataset.n));
        await page.locator("#finer").fill(String(n - 1));
        assert.equal(await page.getAttribute(card(ends.at(-1)), "aria-pressed"), "true");
        await page.click(card(wanted.n));
      } else {
        await page.keyboard.press(String(coarse.n));
        const at = () => page.$eval("#finer", (slider) => Number(slider.value));
        const begin = await at();
        await page.keyboard.press("ArrowRight");
        assert.equal(await at(), begin + 1);
        await page.keyboard.press("ArrowLeft");
        assert.ok((await text(page, ".choice output")).startsWith(`Proposal ${coarse.n}:`));
        await page.keyboard.press(String(wanted.n));
      }
      assert.equal(
        await text(page, ".choice output"),
        `Proposal ${wanted.n}: ${wanted.n_labels} labels`,
      );
      assert.equal(await page.getAttribute(card(wanted.n), "aria-pressed"), "true");
      await page.waitForSelector(`.large canvas[data-drawn="${wanted.n}"]`);
      await page.waitForTimeout(300);
      assert.notDeepEqual(await pictures(page, ".large"), large);
      await shot(page, `proposals-${way}`);
      assert.deepEqual(everything(), before, "nothing is changed yet");
      if (way === "mouse") await page.click("#choose");
      else await page.keyboard.press("Enter");
      await toast(page, `Proposal ${wanted.n} is the labels now: ${wanted.n_labels} labels`);
      settled();
      const isChosen = () => {
        const used = new Set(everything().flatMap(([, labels]) => labels));
        assert.equal(used.size, wanted.n_labels);
        const now = proposals().proposals.find((p) => p.in_force);
        assert.equal(now?.n, wanted.n);
      };
      isChosen();
      await page.waitForFunction(
        (selector) => document.querySelector(selector)?.textContent.includes("in force"),
        card(wanted.n),
      );
      assert.ok(await page.isDisabled("#choose"), "it is in force already");
      for (const [keys, word, check] of [
        ["Control+z", "Undone: ", () => assert.deepEqual(everything(), before)],
        ["Control+Shift+z", "Redone: ", isChosen],
        ["Control+z", "Undone: ", () => assert.deepEqual(everything(), before)],
      ]) {
        await page.keyboard.press(keys);
        await toast(page, `${word}the choice of proposal ${wanted.n}.`);
        settled();
        check();
      }
      await page.keyboard.press("Escape");
      assert.ok((await page.isHidden("#proposals")) && !(await page.isHidden("#gallery")));
      await page.goBack();
      await made(page, set);
      await finish(page);
    });

  await test("the page says why there are no proposals yet", async () => {
    const page = await open(`${url}#${PAIR}?show=proposals`);
    await page.waitForFunction(() =>
      /^Nothing is proposed .* from 3 shapes on/.test(
        document.querySelector("#proposing")?.textContent,
      ),
    );
    assert.equal(await page.$$eval(".division", (cards) => cards.length), 0);
    const steps = { proposals: [], set: "", n_steps: 12, n_done: 2, shapes: [], colours: [] };
    await page.route(`${url}api/proposals*`, (route) => route.fulfill({ json: steps }));
    await page.waitForFunction(() =>
      document.querySelector("#proposing")?.textContent.includes("2 of 12 steps are done"),
    );
    await shot(page, "no-proposals");
    await finish(page);
  });

  await test("proposals keep nobody out, says axe", async () => {
    const { set } = proposals();
    for (const size of SIZES) {
      const page = await open(`${url}#${C}?show=proposals`, size);
      await made(page, set);
      assert.deepEqual(await violations(page), [], JSON.stringify(size));
      const width = await page.$eval("body", (b) => b.scrollWidth);
      assert.ok(width <= (size.width ?? 1440), `the page is ${width} pixels wide`);
      await shot(page, `proposals-${size.theme ?? size.width ?? "light"}`);
      await finish(page);
    }
  });
}

async function linkTests({ test, open, shot, url, finish }) {
  for (const way of ["mouse", "keyboard"])
    await test(`two clicks link parts of two shapes: by ${way}`, async () => {
      const before = everything();
      const [first, second] = names();
      const label = parts(first)[0].label;
      // A part of the second shape that has another label, and can be seen.
      const part = parts(second).findIndex((p) => p.label !== label);
      assert.ok(part >= 0 && part < 9);
      const [a, b] = [`${first}:0`, `${second}:${part}`];
      const page = await open(`${url}#${C}`);
      if (way === "mouse") {
        await select(page, first);
        await page.click("[data-mode=link]");
      } else {
        await page.focus(`.card[data-name="${first}"]`);
        await page.keyboard.press("Enter");
        await shown(page, first, "labels");
        await page.keyboard.press("k");
      }
      await shown(page, first, "link");
      const isChosen = (part) =>
        page.waitForFunction(
          (part) => document.querySelector("#link-state")?.textContent.startsWith(`${part} `),
          part,
        );
      if (way === "mouse") await page.mouse.click(...(await over(page, a)));
      else await page.keyboard.press("1");
      await isChosen(a);
      await page.waitForSelector(".part[aria-pressed=true]");
      if (way === "mouse") await page.click(`.card[data-name="${second}"]`);
      else await page.keyboard.press("ArrowRight");
      await shown(page, second, "link");
      const captions = () => page.$$eval("#captions > div", (all) => all.map((c) => c.textContent));
      assert.equal((await captions()).length, 2, "both shapes are seen");
      await shot(page, `link-${way}`);
      if (way === "mouse") await page.mouse.click(...(await over(page, b)));
      else await page.keyboard.press(String(part + 1));
      await toast(page, `${a} and ${b} have one label from now on`);
      settled();
      const isLinked = () => {
        const [link] = links();
        assert.deepEqual(
          [link.kind, `${link.a.shape}:${link.a.part}`, `${link.b.shape}:${link.b.part}`],
          ["same", a, b],
        );
        assert.ok(link.holds, "the parts have one label");
      };
      isLinked();
      await page.waitForSelector(".links li[data-state=holds]");
      const remove = `.links [data-link="${links()[0].id}"]`;
      if (way === "mouse") await page.click(remove);
      else {
        await page.focus(remove);
        await page.keyboard.press("Enter");
      }
      await toast(page, `${a} and ${b} are not linked any more.`);
      settled();
      assert.deepEqual(links(), []);
      for (const [keys, word, check] of [
        ["Control+z", "Undone: the removal of link", isLinked],
        ["Control+z", "Undone: the link of", () => assert.deepEqual(links(), [])],
        ["Control+Shift+z", "Redone: the link of", isLinked],
        ["Control+Shift+z", "Redone: the removal of link", () => assert.deepEqual(links(), [])],
        ["Control+z", "Undone: the removal of link", isLinked],
        ["Control+z", "Undone: the link of", () => assert.deepEqual(links(), [])],
      ]) {
        await page.keyboard.press(keys);
        await toast(page, word);
        settled();
        check();
      }
      assert.deepEqual(everything(), before);
      await finish(page);
    });

  await test("parts of one shape differ, and the opposite is refused with its reason", async () => {
    const [first] = names();
    const all = parts(first);
    const other = all.findIndex((p) => p.label !== all[0].label);
    const [a, b] = [`${first}:0`, `${first}:${other}`];
    const page = await open(`${url}#${C}/${first}/link`);
    await shown(page, first, "link");
    await page.keyboard.press("d");
    await page.keyboard.press("1");
    await page.waitForSelector("#link-drop");
    await page.keyboard.press("Escape");
    await page.waitForSelector("#link-drop", { state: "detached" });
    assert.ok(!(await page.isHidden("#stage")), "Esc lets the part go, and the shape stays");
    // The cursor, moved by keys, says which part it is on, and Space chooses it.
    await page.focus("#scene");
    const spoken = () => text(page, "#spoken");
    for (const key of ["ArrowUp", ...Array(40).fill("ArrowDown")]) {
      await page.keyboard.press(key);
      if ((await spoken()).startsWith(`${first}:`)) break;
    }
    const [, part] = /^.*:(\d+),/.exec(await spoken());
    await page.keyboard.press("Space");
    await page.waitForFunction(
      (part) => document.querySelector("#link-state").textContent.startsWith(part),
      `${first}:${part} `,
    );
    await page.keyboard.press("Escape");
    await page.waitForSelector("#link-drop", { state: "detached" });
    await page.keyboard.press("1");
    await page.waitForSelector("#link-drop");
    await page.keyboard.press(String(other + 1));
    await toast(page, `${a} and ${b} have different labels from now on`);
    assert.equal(links()[0].kind, "differ");
    await page.waitForFunction(() =>
      document.querySelector("#link-state").textContent.startsWith("Click a part"),
    );
    // Their labels differed before, so that parts have the same numbers.
    await page.keyboard.press("s");
    await page.keyboard.press("1");
    await page.waitForSelector("#link-drop");
    await page.keyboard.press(String(other + 1));
    await page.waitForSelector("#advice:not([hidden])");
    const why = await text(page, "#advice");
    assert.ok(why.includes(a) && why.includes(b) && /contradict|another label/i.test(why), why);
    await shot(page, "link-refused");
    assert.equal(links().length, 1);
    await page.keyboard.press("Escape");
    await page.keyboard.press("Control+z");
    await toast(page, "Undone: the link of");
    assert.deepEqual(links(), []);
    page.faults = page.faults.filter((fault) => !refusal(fault));
    await finish(page);
  });
}

async function attentionTests({ test, open, url, finish }) {
  await test("the page says what it shows, and how long others take", async () => {
    const [first, second] = names();
    const page = await open(`${url}#${C}/${second}`);
    await shown(page, second, "labels");
    const asked = await page.waitForRequest((request) => {
      const query = new URL(request.url()).searchParams;
      return query.get("collection") === C && query.getAll("first")[0] === second;
    });
    const shows = new URL(asked.url()).searchParams.getAll("first");
    assert.ok(shows.includes(first), `${shows}`);
    assert.equal(new Set(shows).size, shows.length);
    const left = [9, 6, 3];
    await page.route(`${url}api/library*`, async (route) => {
      const json = await (await route.fetch()).json();
      json.collections.find((c) => c.name === C).n_stale = left.shift() ?? 0;
      await route.fulfill({ json });
    });
    for (const text of [/^9 to relabel$/, /^6 to relabel · about \d+ s$/, /^live$/])
      await page.waitForFunction(
        (source) => new RegExp(source).test(document.querySelector("#state").textContent),
        text.source,
      );
    await page.unrouteAll({ behavior: "ignoreErrors" });
    await finish(page);
  });
}

export async function choiceTests(kit) {
  const finish = async (page) => {
    assert.deepEqual(page.faults, []);
    await page.context().close();
  };
  await proposalTests({ ...kit, finish });
  await linkTests({ ...kit, finish });
  await attentionTests({ ...kit, finish });
}
