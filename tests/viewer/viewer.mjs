// Drives the viewer in headless Chromium and looks at what it shows.
//
//   node viewer.mjs empty URL OUT          a library without a collection
//   node viewer.mjs all URL OUT FILE       everything, live and from a file; COSEG_BIN and COSEG_ENDPOINT are set
//   node viewer.mjs pictures URL OUT FOLDER the pictures of the documents; FOLDER has the made chairs with their true labels
//   node viewer.mjs many URL OUT FILE      how soon a collection of hundreds, `many`, appears; COSEG_VIEWER_MS is the limit

import assert from "node:assert/strict";
import { execFileSync } from "node:child_process";
import { readFileSync } from "node:fs";
import { pathToFileURL } from "node:url";
import { chromium } from "playwright-core";
import { accessTests, violations } from "./access.mjs";

const [what, url, out, file] = process.argv.slice(2);
const coseg = (...args) => JSON.parse(execFileSync(process.env.COSEG_BIN, [...args, "--json", "--timeout", "60"], { encoding: "utf8" }));

const browser = await chromium.launch({
  executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium",
  // As on any machine without a graphics card; WebGL is emulated, which has to be allowed.
  args: ["--no-sandbox", "--enable-unsafe-swiftshader"],
});

let passed = 0;
let failed = 0;
async function test(name, work) {
  try {
    await work();
    passed += 1;
    console.log(`ok   ${name}`);
  } catch (error) {
    failed += 1;
    console.log(`FAIL ${name}\n${error.stack ?? error}`);
  }
}

/** A page that fails the test that uses it if anything goes wrong in it or anything else is asked for. */
async function open(address, { theme = "light", width = 1440, height = 900 } = {}) {
  const context = await browser.newContext({ viewport: { width, height }, colorScheme: theme });
  const page = await context.newPage();
  page.setDefaultTimeout(90_000);
  page.faults = [];
  page.on("console", (message) => message.type() === "error" && page.faults.push(message.text()));
  page.on("pageerror", (error) => page.faults.push(String(error)));
  page.on("dialog", (dialog) => dialog.accept());
  page.on("request", (request) => {
    const target = request.url();
    const own = target.startsWith(url) || target.startsWith("file:") || target.startsWith("data:");
    if (!own) page.faults.push(`asked for ${target}`);
  });
  await page.goto(address);
  await page.waitForSelector("html[data-ready]", { timeout: 60_000 });
  return page;
}

/** Distinct colours of a canvas, coarsely; one or two mean that nothing was drawn. */
const colours = (page, selector) =>
  page.$eval(selector, (canvas) => {
    const copy = document.createElement("canvas");
    [copy.width, copy.height] = [canvas.width, canvas.height];
    const context = copy.getContext("2d");
    context.drawImage(canvas, 0, 0);
    const { data } = context.getImageData(0, 0, copy.width, copy.height);
    const seen = new Set();
    for (let i = 0; i < data.length; i += 4) seen.add(`${data[i] >> 5} ${data[i + 1] >> 5} ${data[i + 2] >> 5}`);
    return seen.size;
  });

async function select(page, name) {
  await page.click(`.card[data-name="${name}"]`);
  await page.waitForSelector(`#stage[data-shown="${name} labels"]`);
}

async function mode(page, name, wanted) {
  await page.click(`[data-mode=${wanted}]`);
  await page.waitForSelector(`#stage[data-shown="${name} ${wanted}"]`);
}

const shot = (page, name) => page.screenshot({ path: `${out}/${name}.png` });
const ready = (page) => page.$eval("html", (root) => ({ ...root.dataset }));

if (what === "many") {
  const limit = Number(process.env.COSEG_VIEWER_MS ?? 2000);
  const n = coseg("ls", "--collection", "many").shapes.length;
  for (const [kind, address] of [["live", `${url}#many`], ["file", pathToFileURL(file).href]]) {
    await test(`${n} shapes appear in under ${limit} ms: ${kind}`, async () => {
      const seen = [];
      for (let round = 0; round < 3; round++) {
        const page = await open(address);
        // Since the page was asked for: all cards are there, and all that are in sight show their shape.
        const { visibleMs, loadedMs } = await ready(page);
        assert.equal(await page.$$eval(".card", (cards) => cards.length), n);
        const drawn = await page.$$eval(".card canvas[data-drawn]", (cards) => cards.length);
        assert.ok(drawn >= 24, `${drawn} pictures are drawn`);
        console.log(`     ${drawn} pictures in sight after ${visibleMs} ms, all ${n} shapes read after ${loadedMs} ms`);
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
    const truth = readFileSync(`${file}/LABEL_NAMES.txt`, "utf8").trim().split("\n").map((line) => line.split(/\s+/).at(-1));
    const votes = new Map();
    for (const { name } of coseg("ls", "--collection", "chairs").shapes) {
      const known = readFileSync(`${file}/${name}.labels.txt`, "utf8").trim().split(/\s+/).map(Number);
      coseg("labels", name, "--collection", "chairs").labels.forEach((label, face) => {
        const of = votes.get(label) ?? votes.set(label, new Map()).get(label);
        of.set(known[face], (of.get(known[face]) ?? 0) + 1);
      });
    }
    const most = [...votes].map(([label, of]) => [label, ...[...of].sort((a, b) => b[1] - a[1])[0]]);
    const given = new Set();
    for (const [label, part] of most.sort((a, b) => b[2] - a[2])) {
      // What is between the legs counts as leg there, but may have a label of its own.
      const name = given.has(truth[part]) ? `${truth[part]} too`.replace("leg too", "stretcher") : truth[part];
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
    await page.waitForFunction(() => document.querySelector("#controls output").textContent.startsWith("6,"));
    await page.waitForTimeout(300);
    await shot(page, "eigenfunction");
    await mode(page, third, "map");
    await page.waitForSelector("canvas.heat");
    await page.waitForTimeout(300);
    await shot(page, "map");
    assert.deepEqual(page.faults, []);
    await page.context().close();
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
    await page.waitForFunction((n) => document.querySelectorAll(".card canvas[data-drawn]").length === n, names.length);
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
    await page.waitForFunction(() => document.querySelector("#controls output").textContent.startsWith("7,"));
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

  await test("a label that is renamed keeps its name in the daemon", async () => {
    const page = await open(`${url}#chairs`);
    const label = await page.getAttribute("#legend .chip", "data-label");
    await page.click("#legend .chip .pencil");
    await page.fill("#legend .chip input", "leg <b>&");
    await page.keyboard.press("Enter");
    await page.waitForFunction(() => document.querySelector("#legend .chip .text")?.textContent === "leg <b>&");
    const labels = coseg("show", "--collection", "chairs").labels;
    assert.equal(labels.find((l) => l.id === Number(label)).name, "leg <b>&");
    assert.deepEqual(page.faults, []);
    await page.context().close();
  });

  await test("a painted correction is sent, carried and undone", async () => {
    const page = await open(`${url}#chairs`);
    await select(page, first);
    await mode(page, first, "correct");
    const before = coseg("labels", first, "--collection", "chairs").labels;
    const chosen = Number(await page.getAttribute(".palette button:last-child", "data-label"));
    await page.click(".palette button:last-child");
    assert.ok(await page.isDisabled("#apply"));
    const box = await page.locator("#scene").boundingBox();
    // Along a line through the middle: somewhere there is the shape.
    for (let i = 0; i <= 12; i++) {
      await page.mouse.move(box.x + box.width / 2, box.y + box.height * (0.2 + i * 0.05));
      await page.mouse.down();
      await page.mouse.up();
    }
    assert.ok(await page.isEnabled("#apply"));
    await shot(page, "correct");
    await page.click("#apply");
    await page.waitForSelector(".toast");
    const after = coseg("labels", first, "--collection", "chairs").labels;
    const n = after.filter((l) => l === chosen).length;
    assert.ok(n > 0 && !before.includes(chosen), `${n} faces have label ${chosen}`);
    coseg("wait", "--collection", "chairs");
    await page.click("#undo");
    await page.waitForFunction(() => [...document.querySelectorAll(".toast")].some((t) => t.textContent.startsWith("Undone: correct")));
    coseg("wait", "--collection", "chairs");
    assert.deepEqual(coseg("labels", first, "--collection", "chairs").labels, before);
    assert.deepEqual(page.faults, []);
    await page.context().close();
  });

  await test("questions are answered by keys, and a change is undone and done again by keys", async () => {
    const page = await open(`${url}#chairs`);
    const before = coseg("labels", first, "--collection", "chairs").labels;
    const question = () => page.$eval("#controls", (c) => c.textContent);
    await page.keyboard.press("q");
    await page.waitForFunction(() => document.querySelector("#controls")?.textContent.includes("0 answered"));
    const asked = new URL(page.url()).hash.split("/")[1];
    await page.waitForSelector(`#stage[data-shown="${asked} ask"]`);
    assert.ok((await colours(page, "#scene")) > 2);
    await shot(page, "question");
    const offered = await page.$$eval(".palette [data-answer]", (all) => all.length);
    assert.ok(offered >= 1 && offered <= 3, await question());
    // Answers by a key, and waits for another question.
    const answer = async (key) => {
      const was = await page.$eval("#controls", (c) => c.dataset.question);
      await page.keyboard.press(key);
      await page.waitForFunction((was) => document.querySelector("#controls").dataset.question !== was, was);
    };
    await page.keyboard.press("n");
    await page.keyboard.type("seat");
    await answer("Enter");
    assert.match(await question(), /1 answered/);
    const seat = coseg("show", "--collection", "chairs").labels.find((l) => l.name === "seat").id;
    assert.ok(coseg("labels", asked, "--collection", "chairs", "--no-wait").labels.includes(seat));
    const inState = (state) => coseg("ls", "chairs", "--review", state).shapes.map((s) => s.name);
    assert.deepEqual(inState("corrected"), [asked]);
    await answer("s");
    assert.match(await question(), /1 answered/);
    await answer("1");
    assert.match(await question(), /2 answered/);
    await page.waitForSelector("#effect:not([hidden])");
    for (const [keys, word, n] of [["Control+z", "Undone: answer", 1], ["Control+Shift+z", "Done again: answer", 2],
      ["Control+z", "Undone: answer", 1], ["Control+z", "Undone: answer", 0]]) {
      await page.evaluate(() => document.querySelectorAll(".toast").forEach((t) => t.remove()));
      await page.keyboard.press(keys);
      await page.waitForFunction((word) => [...document.querySelectorAll(".toast")].some((t) => t.textContent.startsWith(word)), word);
      assert.equal(inState("corrected").length <= n, true, `${keys}: ${inState("corrected")}`);
    }
    coseg("wait", "--collection", "chairs");
    assert.deepEqual(coseg("labels", first, "--collection", "chairs").labels, before);
    assert.deepEqual(page.faults, []);
    await page.context().close();
  });

  await test("a shape is approved by a key, found by its verdict, and → goes to the next shape", async () => {
    const page = await open(`${url}#chairs`);
    await page.focus(`.card[data-name="${first}"]`);
    await page.keyboard.press("Enter");
    await page.waitForSelector(`#stage[data-shown="${first} labels"]`);
    await page.keyboard.press("ArrowRight");
    await page.waitForSelector(`#stage[data-shown="${second} labels"]`);
    await page.keyboard.press("y");
    await page.waitForFunction(() => document.querySelector("#verdict")?.textContent.startsWith("approved"));
    assert.match(await page.textContent(`.card[data-name="${second}"]`), /approved/);
    await page.selectOption("#review", "approved");
    await page.waitForFunction(() => document.querySelectorAll(".card").length === 1);
    assert.match(await page.textContent("#count"), /1 of \d+ shapes, 1 approved/);
    await shot(page, "approved");
    await page.selectOption("#review", "");
    coseg("wait", "--collection", "chairs");
    await page.keyboard.press("Control+z");
    await page.waitForFunction((name) => [...document.querySelectorAll(".toast")].some((t) => t.textContent.startsWith(`Undone: approve of ${name}.`)), second);
    assert.deepEqual(coseg("ls", "chairs", "--review", "approved").shapes, []);
    coseg("wait", "--collection", "chairs");
    assert.deepEqual(page.faults, []);
    await page.context().close();
  });

  await test("strokes are undone and done again, erased, and painted by keys", async () => {
    const page = await open(`${url}#chairs`);
    await select(page, first);
    await mode(page, first, "correct");
    const painted = () => page.$eval("#controls .ends", (e) => Number(/^([\d,]+) face/.exec(e.textContent)?.[1].replace(",", "") ?? 0));
    await page.locator("#scene").focus();
    await page.keyboard.press("2");
    assert.equal(await page.getAttribute(".palette button:nth-child(2)", "aria-pressed"), "true");
    const box = await page.locator("#scene").boundingBox();
    const strokes = async () => {
      for (let i = 0; i <= 12; i++) {
        await page.mouse.move(box.x + box.width / 2, box.y + box.height * (0.2 + i * 0.05));
        await page.mouse.down();
        await page.mouse.up();
      }
    };
    await strokes();
    const all = await painted();
    assert.ok(all > 0);
    await page.keyboard.press("Control+z");
    const less = await painted();
    assert.ok(less < all, `${less} of ${all} faces after undo`);
    await page.keyboard.press("Control+Shift+z");
    assert.equal(await painted(), all);
    await page.keyboard.press("e");
    await strokes();
    assert.equal(await painted(), 0);
    await page.keyboard.press("Control+z");
    assert.ok((await painted()) > 0, "erasing is a stroke too");
    await shot(page, "strokes");
    await page.click("#discard");
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
    console.log(`     first pictures after ${times.visibleMs} ms, all shapes read after ${times.loadedMs} ms`);
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

  await accessTests({ test, open, coseg, shot, url, file: pathToFileURL(file).href, names });
}

await browser.close();
console.log(`${passed} passed, ${failed} failed`);
process.exit(failed ? 1 : 0);
