// Plays a person who has a minute for a collection, `vases`, and knows what its parts are.
//
//   node session.mjs URL OUT FOLDER   FOLDER has the made vases with their true labels
//
// The clock runs while she thinks, presses and waits for the page; it stands still while the labels
// are measured. She thinks for as long as the constants say.

import assert from "node:assert/strict";
import { writeFileSync } from "node:fs";
import { coseg, launch, opener, shown } from "./page.mjs";
import { sheet } from "./sheet.mjs";
import { Truth } from "./truth.mjs";

/** Milliseconds to see what a question is about, and to find the next thing to do. */
const GLANCE_MS = 900;
const LOOK_MS = 1_800;
/** A part with less of its area in one true part is cut wrongly. */
const WHOLE = 0.7;
/** Number of questions that she answers. */
const N_QUESTIONS = 6;
/** Distance in pixels of the places where she looks at a shape. */
const GRID = 22;

const [url, out, folder] = process.argv.slice(2);
const C = "vases";
const browser = await launch();
const page = await opener(browser, url)(`${url}#${C}`, { width: 1280, height: 800 });
const truth = new Truth(folder, C);
const steps = [];
/** The questions that the page got. */
const questions = new Map();
page.on("response", async (response) => {
  if (!response.url().includes("/api/question")) return;
  const question = await response.json();
  questions.set(question.id, question);
});
let began = performance.now();
const think = (ms) => page.waitForTimeout(ms);

/** Notes a step with a picture and the accuracy; the clock stands still meanwhile. */
async function note(pressed, what, onSheet = false) {
  const stopped = performance.now();
  await page.waitForTimeout(250);
  const picture = `session-${String(steps.length).padStart(2, "0")}.png`;
  await page.screenshot({ path: `${out}/${picture}` });
  const effect = await page.evaluate(() => {
    const box = document.querySelector("#effect");
    return box.hidden ? "" : box.querySelector("span").textContent;
  });
  const { accuracy } = truth.measure();
  const at = (stopped - began) / 1000;
  steps.push({ seconds: Number(at.toFixed(1)), pressed, what, effect, accuracy, picture, onSheet });
  console.log(
    `${at.toFixed(1).padStart(5)} s  ${accuracy.toFixed(3)}  ${pressed}: ${what} [${effect}]`,
  );
  began += performance.now() - stopped;
}

async function press(selector) {
  await page.click(selector);
}

/** Names each label after what most of it is; a second label for the same part is merged. */
async function sortLabels() {
  const { rows } = truth.measure();
  const owner = new Map();
  const most = [...rows].map(([label, row]) => ({
    label,
    at: row.indexOf(Math.max(...row)),
    share: Math.max(...row),
  }));
  for (const { label, at } of most.sort((a, b) => b.share - a.share)) {
    const name = truth.names[at];
    await think(LOOK_MS);
    await press(`#legend [data-label="${label}"] .pencil`);
    await page.waitForSelector("#editor:not([hidden])");
    if (owner.has(at)) {
      await page.selectOption("#label-into", String(owner.get(at)));
      await think(GLANCE_MS);
      await note(
        "pencil, merge into",
        `a second label for ${name}: the shapes show what will change`,
      );
      await press("#label-merge");
    } else {
      await page.keyboard.type(name, { delay: 60 });
      await page.keyboard.press("Enter");
      owner.set(at, label);
    }
    await page.waitForSelector("#editor", { state: "hidden" });
  }
  await note("pencils, names, Enter", `${owner.size} labels have names`, true);
}

/** Answers the question on the page by what the part truly is. */
async function answer() {
  const was = await page.getAttribute("#controls", "data-question");
  const asked = questions.get(was);
  await think(GLANCE_MS);
  const { name, share } = truth.most(asked.shape, asked.faces);
  const at = asked.likeliest.findIndex((l) => l.name === name);
  let pressed = String(at + 1);
  if (share < WHOLE) pressed = "x";
  else if (at < 0) pressed = `n ${name} Enter`;
  if (pressed.startsWith("n ")) {
    await page.keyboard.press("n");
    await page.keyboard.type(name, { delay: 60 });
    await page.keyboard.press("Enter");
  } else await page.keyboard.press(pressed);
  await page.waitForFunction(
    (was) => document.querySelector("#controls").dataset.question !== was,
    was,
  );
  const said = share < WHOLE ? "is cut wrongly" : `is ${name}`;
  return [pressed, `part ${asked.part} of ${asked.shape} ${said}`];
}

/** Looks at a shape in a grid, and returns places whose label is wrong, with the right one. */
async function wrongPlaces(shape) {
  const { labels } = truth.shapes.get(shape);
  const box = await page.locator("#scene").boundingBox();
  const found = [];
  for (let y = box.y + GRID; y < box.y + box.height; y += GRID)
    for (let x = box.x + GRID; x < box.x + box.width; x += GRID) {
      await page.mouse.move(x, y);
      const seen = await page.evaluate(() => {
        const hint = document.querySelector("#hint");
        return hint.hidden ? null : [Number(hint.dataset.polygon), hint.textContent];
      });
      if (!seen) continue;
      const right = truth.names[labels[seen[0]]];
      if (right !== seen[1]) found.push({ x, y, right });
    }
  return found;
}

/** Brushes over what is wrong on the suggested shape, from where she looks at it. */
async function correct() {
  await think(GLANCE_MS);
  await page.keyboard.press("g");
  await page.waitForFunction(() => location.hash.includes("/correct"));
  const shape = decodeURIComponent(new URL(page.url()).hash.split("/")[1]);
  await shown(page, shape, "correct");
  // A person sees at once what is wrong.
  const stopped = performance.now();
  const places = await wrongPlaces(shape);
  began += performance.now() - stopped;
  await think(LOOK_MS);
  let fresh = null;
  for (const name of new Set(places.map((p) => p.right))) {
    const button = page.locator(`.palette button:has-text("${name}")`);
    if (await button.count()) await button.click();
    else if (fresh) continue;
    else {
      const label = await page.getAttribute(".palette button:last-child", "data-label");
      fresh = { name, label };
      await press(".palette button:last-child");
    }
    const here = places.filter((p) => p.right === name);
    for (const row of new Set(here.map((p) => p.y))) {
      const line = here.filter((p) => p.y === row);
      await page.mouse.move(line[0].x, row);
      await page.mouse.down();
      await page.mouse.move(line.at(-1).x, row, { steps: line.length });
      await page.mouse.up();
    }
  }
  await note("g, brush", `${shape} was suggested; ${await page.textContent("#amount")}`, true);
  if (!places.length) return;
  await page.focus("#scene");
  await page.keyboard.press("Enter");
  await page.waitForSelector("#apply:disabled");
  await think(GLANCE_MS);
  await note("Enter", `${shape} is corrected`);
  if (!fresh) return;
  await press(`#legend [data-label="${fresh.label}"] .pencil`);
  await page.keyboard.type(fresh.name, { delay: 60 });
  await page.keyboard.press("Enter");
  await page.waitForSelector("#editor", { state: "hidden" });
  await note("pencil, name", `the new label is called ${fresh.name}`);
}

/** Looks at what the last change did. */
async function compare() {
  await press("#moved-first");
  await think(LOOK_MS);
  await note("Changed first", "the cards are in the order of what changed");
  await page.keyboard.press("v");
  await think(LOOK_MS);
  await note("v", "the shapes as they were before", true);
  await page.keyboard.press("v");
  await think(GLANCE_MS);
}

await note("nothing yet", "20 vases as they were found, without any label by a person", true);
await sortLabels();
await think(GLANCE_MS);
await page.keyboard.press("q");
await page.waitForSelector("#ask-name");
for (let n = 0; n < N_QUESTIONS; n++) await note(...(await answer()), n === 1);
await correct();
await compare();
await page.keyboard.press("y");
await page.waitForFunction(() => /^Approved/.test(document.querySelector("#verdict")?.textContent));
await note("y", "the shape is approved");
await page.keyboard.press("l");
await page.waitForSelector("#editor:not([hidden])");
await press("#label-split");
await page.waitForSelector("#editor", { state: "hidden" });
await think(GLANCE_MS);
await note("l, Split in two", "a split that was not wanted");
await page.keyboard.press("Control+z");
await page.waitForFunction(() =>
  [...document.querySelectorAll(".toast")].some((t) => t.textContent.startsWith("Undone")),
);
await note("Ctrl+Z", "the split is taken back");
coseg("wait", "--collection", C);
await page.keyboard.press("Escape");
await page.waitForFunction(() => document.querySelector("#state").textContent === "live");
await note("Esc", "all shapes follow", true);
assert.deepEqual(page.faults, []);
assert.ok(steps.at(-1).accuracy > steps[0].accuracy, "the labels are no better than before");
writeFileSync(`${out}/session.json`, JSON.stringify(steps, null, 1));
const line = (s) =>
  `| ${s.seconds.toFixed(1)} | ${s.pressed} | ${s.what} | ${s.accuracy.toFixed(3)} |`;
const table = [
  "| s | pressed | what | accuracy |",
  "| --- | --- | --- | --- |",
  ...steps.map(line),
];
writeFileSync(`${out}/session.md`, `${table.join("\n")}\n`);
await sheet(browser, out, steps);
await browser.close();
