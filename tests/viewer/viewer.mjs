// Drives the viewer in headless Chromium and looks at what it shows.
//
//   node viewer.mjs empty URL OUT          a library without a collection
//   node viewer.mjs all URL OUT FILE       everything, live and from a file
//   node viewer.mjs pictures URL OUT FOLDER
//                                          the pictures of the documents; FOLDER has the chairs
//                                          with their true labels
//   node viewer.mjs many URL OUT FILE      how soon a collection of hundreds, `many`, appears;
//                                          COSEG_VIEWER_MS is the limit
//
// COSEG_BIN and COSEG_ENDPOINT are set.

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { pathToFileURL } from "node:url";
import { accessTests, violations } from "./access.mjs";
import { choiceTests } from "./choices.mjs";
import { labelTests } from "./labels.mjs";
import { Tests, colours, coseg, launch, mode, opener, select } from "./page.mjs";
import { paintTests } from "./paint.mjs";
import { verdictTests } from "./verdicts.mjs";

const [what, url, out, file] = process.argv.slice(2);
const browser = await launch();
const open = opener(browser, url);
const tests = new Tests();
const { test } = tests;

const shot = (page, name) => page.screenshot({ path: `${out}/${name}.png` });
const ready = (page) => page.$eval("html", (root) => ({ ...root.dataset }));

if (what === "many") {
  const limit = Number(process.env.COSEG_VIEWER_MS ?? 2000);
  const n = coseg("ls", "--collection", "many").shapes.length;
  for (const [kind, address] of [
    ["live", `${url}#many`],
    ["file", pathToFileURL(file).href],
  ]) {
    await test(`${n} shapes appear in under ${limit} ms: ${kind}`, async () => {
      const seen = [];
      for (let round = 0; round < 3; round++) {
        const page = await open(address);
        // Since the page was asked for: all cards are there, and those in sight show their shape.
        const { visibleMs, loadedMs } = await ready(page);
        assert.equal(await page.$$eval(".card", (cards) => cards.length), n);
        const drawn = await page.$$eval(".card canvas[data-drawn]", (cards) => cards.length);
        assert.ok(drawn >= 24, `${drawn} pictures are drawn`);
        console.log(
          `     ${drawn} pictures in sight after ${visibleMs} ms, ` +
            `all ${n} shapes read after ${loadedMs} ms`,
        );
        seen.push(Number(visibleMs));
        if (round === 0) await shot(page, `many-${kind}`);
        // One at the end of the list appears when it comes into sight.
        await page.locator(".card").last().scrollIntoViewIfNeeded();
        await page.waitForSelector(".card:last-child canvas[data-drawn]");
        assert.deepEqual(page.faults, []);
        await page.context().close();
      }
      const median = seen.sort((a, b) => a - b)[1];
      assert.ok(median < limit, `of three, the middle one took ${median} ms`);
    });
  }
} else if (what === "pictures") {
  await test("the pictures of the documents", async () => {
    // Each label is called what most of its faces truly are.
    const truth = readFileSync(`${file}/LABEL_NAMES.txt`, "utf8")
      .trim()
      .split("\n")
      .map((line) => line.split(/\s+/).at(-1));
    const votes = new Map();
    for (const { name } of coseg("ls", "--collection", "chairs").shapes) {
      const known = readFileSync(`${file}/${name}.labels.txt`, "utf8")
        .trim()
        .split(/\s+/)
        .map(Number);
      coseg("labels", name, "--collection", "chairs").labels.forEach((label, face) => {
        const of = votes.get(label) ?? votes.set(label, new Map()).get(label);
        of.set(known[face], (of.get(known[face]) ?? 0) + 1);
      });
    }
    const most = [...votes].map(([label, of]) => [
      label,
      ...[...of].sort((a, b) => b[1] - a[1])[0],
    ]);
    const given = new Set();
    for (const [label, part] of most.sort((a, b) => b[2] - a[2])) {
      // What is between the legs counts as leg there, but may have a label of its own.
      const name = given.has(truth[part])
        ? `${truth[part]} too`.replace("leg too", "stretcher")
        : truth[part];
      given.add(name);
      coseg("name", String(label), name, "--collection", "chairs");
    }
    const [, second, third] = coseg("ls", "--collection", "chairs").shapes.map((s) => s.name);
    const page = await open(`${url}#chairs`, { width: 1280, height: 520 });
    await shot(page, "gallery");
    await page.setViewportSize({ width: 1280, height: 760 });
    await select(page, second);
    await page.waitForSelector(".near canvas[data-drawn]");
    await page.mouse.move(0, 0);
    await shot(page, "shape");
    await page.click("#theme");
    await select(page, third);
    await mode(page, third, "eigen");
    await page.locator("#controls input[type=range]").fill("5");
    await page.waitForFunction(() =>
      document.querySelector("#controls output").textContent.startsWith("6,"),
    );
    await page.waitForTimeout(300);
    await shot(page, "eigenfunction");
    await mode(page, third, "map");
    await page.waitForSelector("canvas.heat");
    await page.waitForTimeout(300);
    await shot(page, "map");
    assert.deepEqual(page.faults, []);
    await page.context().close();
    const { set } = coseg("proposals", "chairs");
    const size = { width: 1280, height: 690 };
    const many = await open(`${url}#chairs?show=proposals`, size);
    await many.waitForSelector(`#proposals[data-ready="${set}"]`);
    await many.evaluate(() => document.activeElement.blur());
    await shot(many, "proposals");
    assert.deepEqual(many.faults, []);
    await many.context().close();
  });
} else if (what === "empty") {
  await test("an empty library says what to do", async () => {
    const page = await open(url);
    assert.match(await page.textContent("#empty"), /coseg add/);
    assert.deepEqual(await violations(page), []);
    await shot(page, "empty");
    assert.deepEqual(page.faults, []);
    await page.context().close();
  });
} else {
  const names = coseg("ls", "--collection", "chairs").shapes.map((s) => s.name);
  const [first, second] = names;

  await test("the gallery shows every shape in the colours of its labels", async () => {
    const page = await open(url);
    await page.selectOption("#collections", "chairs");
    await page.waitForFunction(
      (n) => document.querySelectorAll(".card canvas[data-drawn]").length === n,
      names.length,
    );
    assert.equal(await page.$$eval(".card", (cards) => cards.length), names.length);
    assert.ok((await colours(page, `.card[data-name="${first}"] canvas`)) > 8);
    await page.waitForSelector("#state.pill");
    await shot(page, "gallery");
    await page.fill("#search", second);
    assert.equal(await page.$$eval(".card", (cards) => cards.length), 1);
    await page.fill("#search", "no such shape");
    assert.match(await page.textContent("#empty"), /Nothing found/);
    await page.fill("#search", "");
    await page.click("#legend .chip");
    assert.match(await page.textContent("#count"), /shapes/);
    assert.deepEqual(page.faults, []);
    await page.context().close();
  });

  await test("a shape is turned, its parts, neighbours and history are listed", async () => {
    const page = await open(`${url}#chairs`);
    await select(page, first);
    const parts = coseg("show", first, "--collection", "chairs").parts;
    assert.equal(await page.$$eval(".part", (rows) => rows.length), parts.length);
    await page.waitForSelector(".near button");
    assert.match(await page.textContent(".log"), /added/);
    const before = await page.$eval("#scene", (c) => c.toDataURL());
    const box = await page.locator("#scene").boundingBox();
    await page.mouse.move(box.x + box.width / 2, box.y + box.height / 2);
    await page.mouse.down();
    await page.mouse.move(box.x + box.width / 2 + 120, box.y + box.height / 2 + 30, { steps: 4 });
    await page.mouse.up();
    await page.waitForTimeout(100);
    assert.notEqual(await page.$eval("#scene", (c) => c.toDataURL()), before);
    await page.mouse.move(box.x + box.width / 2, box.y + box.height / 2 + 1);
    await shot(page, "shape");
    await page.keyboard.press("Escape");
    assert.ok(await page.isHidden("#stage"));
    assert.deepEqual(page.faults, []);
    await page.context().close();
  });

  await test("functions and maps are shown as colours", async () => {
    const page = await open(`${url}#chairs`, { theme: "dark" });
    await select(page, second);
    await mode(page, second, "eigen");
    assert.ok((await colours(page, "#scene")) > 8);
    const first = await page.$eval("#scene", (c) => c.toDataURL());
    await page.locator("#controls input[type=range]").fill("6");
    await page.waitForFunction(() =>
      document.querySelector("#controls output").textContent.startsWith("7,"),
    );
    await page.waitForTimeout(150);
    assert.notEqual(await page.$eval("#scene", (c) => c.toDataURL()), first);
    await shot(page, "eigenfunction");
    await mode(page, second, "hks");
    assert.match(await page.textContent("#controls output"), /t = /);
    await shot(page, "hks");
    await mode(page, second, "map");
    await page.waitForSelector("canvas.heat");
    assert.ok((await colours(page, "canvas.heat")) > 4);
    assert.equal(await page.$$eval("#captions > div", (c) => c.length), 2);
    await shot(page, "map");
    assert.deepEqual(page.faults, []);
    await page.context().close();
  });

  await test("other sites' pages change nothing", async () => {
    const body = JSON.stringify({ collection: "chairs" });
    const post = (headers) => fetch(`${url}api/undo`, { method: "POST", body, headers });
    assert.equal((await post({})).status, 403);
    assert.equal((await post({ "x-coseg": "1", origin: "http://example.org" })).status, 403);
    assert.equal((await fetch(`${url}metrics`)).status, 200);
    assert.match(await (await fetch(`${url}readyz`)).text(), /ready/);
  });

  await test("the page is one file that needs nothing else", async () => {
    const page = await open(pathToFileURL(file).href);
    const times = await ready(page);
    console.log(
      `     first pictures after ${times.visibleMs} ms, all shapes read after ${times.loadedMs} ms`,
    );
    assert.equal(await page.$$eval(".card", (cards) => cards.length), names.length);
    assert.ok((await colours(page, `.card[data-name="${first}"] canvas`)) > 8);
    await select(page, second);
    for (const wanted of ["eigen", "hks", "map"]) {
      await mode(page, second, wanted);
      assert.ok((await colours(page, "#scene")) > 8, wanted);
      assert.ok(await page.isHidden("#notice"), wanted);
    }
    assert.ok(await page.isHidden("[data-mode=correct]"));
    assert.ok(await page.isHidden("#undo"));
    await shot(page, "file");
    assert.deepEqual(page.faults, []);
    await page.context().close();
  });

  await test("a narrow screen shows the shape with its parts below", async () => {
    const page = await open(`${url}#chairs/${first}/labels`, { width: 420, height: 860 });
    await page.waitForSelector(`#stage[data-shown="${first} labels"]`);
    const width = await page.$eval("body", (b) => b.scrollWidth);
    assert.ok(width <= 420, `the page is ${width} pixels wide`);
    await shot(page, "narrow");
    assert.deepEqual(page.faults, []);
    await page.context().close();
  });

  const kit = { test, open, coseg, shot, url, file: pathToFileURL(file).href, names };
  await choiceTests(kit);
  await labelTests(kit);
  await verdictTests(kit);
  await paintTests(kit);
  await accessTests(kit);
}

await browser.close();
console.log(`${tests.passed} passed, ${tests.failed} failed`);
process.exit(tests.failed || !tests.passed ? 1 : 0);
