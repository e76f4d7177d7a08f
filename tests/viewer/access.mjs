// The viewer by keyboard, by address and as assistive technology sees it.

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { createRequire } from "node:module";

const AXE = readFileSync(createRequire(import.meta.url).resolve("axe-core/axe.min.js"), "utf8");
/** Every view of a shape. */
const VIEWS = ["labels", "eigen", "hks", "map", "history"];
/** Tab is pressed no more often than this before everything must have had the focus. */
const MOST_TABS = 200;

/** Violations that keep somebody out, as one line each. */
export async function violations(page) {
  await page.evaluate(AXE);
  const found = await page.evaluate(
    async () => (await window.axe.run(document, { resultTypes: ["violations"] })).violations,
  );
  return found
    .filter((v) => ["serious", "critical"].includes(v.impact))
    .map((v) => `${v.id}: ${v.nodes.map((n) => n.target.join(" ")).join(", ")}`);
}

const shown = (page, name, view) => page.waitForSelector(`#stage[data-shown="${name} ${view}"]`);
const address = (page) => page.evaluate(() => location.hash);

/** What can have the focus and can be seen, named. */
const focusable = (page) =>
  page.evaluate(() => {
    const all = [
      ...document.querySelectorAll("button, select, input, canvas[tabindex], aside[tabindex]"),
    ];
    const there = all.filter((e) => !e.disabled && e.tabIndex >= 0 && e.checkVisibility());
    there.forEach(
      (e, i) =>
        (e.dataset.seen ??= `${e.id || e.dataset.name || e.textContent.trim() || e.tagName} ${i}`),
    );
    return there.map((e) => e.dataset.seen);
  });

const focused = (page) =>
  page.evaluate(() => {
    const e = document.activeElement;
    if (!e || e === document.body) return null;
    const style = getComputedStyle(e);
    const box = e.getBoundingClientRect();
    const inside =
      box.bottom > 0 && box.top < innerHeight && box.right > 0 && box.left < innerWidth;
    return {
      name: e.dataset.seen,
      visible: style.outlineStyle !== "none" && parseFloat(style.outlineWidth) >= 2 && inside,
    };
  });

/**
 * Presses a key until everything that can have the focus had it; fails if the focus stays somewhere
 * or cannot be seen.
 */
async function walk(page, key) {
  const wanted = new Set(await focusable(page));
  assert.ok(wanted.size > 5, `${wanted.size} things can have the focus`);
  let before = null;
  for (let i = 0; i < MOST_TABS && wanted.size > 0; i++) {
    await page.keyboard.press(key);
    const now = await focused(page);
    if (now) {
      assert.notEqual(now.name, before, `${key} does not leave ${now.name}`);
      assert.ok(now.visible, `the focus on ${now.name} cannot be seen`);
      wanted.delete(now.name);
    }
    before = now?.name ?? null;
  }
  assert.deepEqual([...wanted], [], `not reached by ${key}`);
}

/**
 * Whether anything is drawn at the sides and ends of the large picture, which has so many shapes.
 */
const cut = (page, n) =>
  page.$eval(
    "#scene",
    (canvas, n) => {
      const copy = document.createElement("canvas");
      [copy.width, copy.height] = [canvas.width, canvas.height];
      const context = copy.getContext("2d");
      context.drawImage(canvas, 0, 0);
      const { data } = context.getImageData(0, 0, copy.width, copy.height);
      const drawn = (x, y) => data[4 * (y * copy.width + x) + 3] > 0;
      const columns = Array.from(
        { length: 2 * n },
        (_, i) => Math.floor(((i + 1) >> 1) * (copy.width / n)) - (i % 2),
      );
      const edge = (x) =>
        Array.from({ length: copy.height }, (_, y) =>
          drawn(Math.min(Math.max(x, 0), copy.width - 1), y),
        ).some(Boolean);
      const row = (y) => Array.from({ length: copy.width }, (_, x) => drawn(x, y)).some(Boolean);
      return {
        sides: columns.filter(edge),
        ends: [0, copy.height - 1].filter(row),
        any: data.some((v, i) => i % 4 === 3 && v > 0),
      };
    },
    n,
  );

export async function accessTests({ test, open, coseg, shot, url, file, names }) {
  const [first, second, third] = names;
  const finish = async (page) => {
    assert.deepEqual(page.faults, []);
    await page.context().close();
  };

  for (const [kind, base] of [
    ["live", url],
    ["file", file],
  ])
    await test(`no view keeps anybody out, says axe: ${kind}`, async () => {
      const views = kind === "live" ? [...VIEWS, "correct", "link"] : VIEWS;
      const sizes = [{}, { theme: "dark" }, { width: 420, height: 860 }];
      for (const size of sizes) {
        const page = await open(`${base}#chairs`, size);
        const found = { gallery: await violations(page) };
        for (const view of views) {
          await page.evaluate((hash) => (location.hash = hash), `#chairs/${second}/${view}`);
          await shown(page, second, view);
          found[view] = await violations(page);
        }
        await page.evaluate(() => (location.hash = "#chairs?search=no+such+shape"));
        await page.waitForSelector("#empty:not([hidden])");
        found.nothing = await violations(page);
        for (const [view, list] of Object.entries(found))
          assert.deepEqual(list, [], `${view} ${JSON.stringify(size)}`);
        await finish(page);
      }
    });

  await test("Tab reaches everything there and back, and it shows where it is", async () => {
    const page = await open(`${url}#chairs`);
    await walk(page, "Tab");
    await walk(page, "Shift+Tab");
    for (const view of ["labels", "map", "correct"]) {
      await page.goto(`${url}#chairs/${second}/${view}`);
      await shown(page, second, view);
      await page.waitForSelector(".near button");
      await walk(page, "Tab");
    }
    await finish(page);
    const narrow = await open(`${url}#chairs/${second}/labels`, { width: 420, height: 860 });
    await shown(narrow, second, "labels");
    await walk(narrow, "Tab");
    await finish(narrow);
  });

  await test("cards, tabs and the shape are used by keyboard alone", async () => {
    const page = await open(`${url}#chairs`);
    const active = () =>
      page.evaluate(
        () => document.activeElement.dataset.name ?? document.activeElement.dataset.mode,
      );
    await page.keyboard.press("Tab");
    assert.equal(await page.evaluate(() => document.activeElement.id), "skip");
    await page.keyboard.press("Enter");
    assert.equal(await active(), first);
    await page.keyboard.press("ArrowRight");
    assert.equal(await active(), second);
    await page.keyboard.press("End");
    assert.equal(await active(), names.at(-1));
    await page.keyboard.press("Home");
    await page.keyboard.press("ArrowDown");
    await page.keyboard.press("ArrowUp");
    assert.equal(await active(), first);
    await page.keyboard.press("Enter");
    await shown(page, first, "labels");
    await page.evaluate(() => document.activeElement.blur());
    await page.keyboard.press("ArrowRight");
    await shown(page, second, "labels");
    await page.focus("[data-mode=labels]");
    await page.keyboard.press("ArrowRight");
    await shown(page, second, "eigen");
    assert.equal(await active(), "eigen");
    await page.keyboard.press("End");
    await shown(page, second, "link");
    await page.keyboard.press("ArrowRight");
    assert.equal(await active(), "link");
    await page.keyboard.press("Home");
    await shown(page, second, "labels");
    await page.focus("#scene");
    const before = await page.$eval("#scene", (c) => c.toDataURL());
    await page.keyboard.press("Shift+ArrowLeft");
    await page.keyboard.press("+");
    await page.waitForFunction((b) => document.querySelector("#scene").toDataURL() !== b, before);
    await page.keyboard.press("Escape");
    assert.ok(await page.isHidden("#stage"));
    assert.equal(await active(), second);
    await finish(page);
  });

  await test("parts are corrected by keyboard, and a toast covers no control", async () => {
    const page = await open(`${url}#chairs/${third}/correct`);
    await shown(page, third, "correct");
    await page.focus(".palette button:last-child");
    await page.keyboard.press("Enter");
    const chosen = await page.evaluate(() => document.activeElement.textContent);
    assert.match(chosen, /new label$/);
    await page.focus(".part");
    await page.keyboard.press("Enter");
    assert.ok(await page.isEnabled("#apply"));
    // A toast while there is something to apply.
    await page.click("#legend .chip:last-child .pencil");
    await page.fill("#label-name", "an end");
    await page.keyboard.press("Enter");
    await page.waitForSelector(".toast");
    await shot(page, "toast");
    const covered = await page.evaluate(() => {
      const toast = document.querySelector(".toast").getBoundingClientRect();
      const over = (b) =>
        b.left < toast.right &&
        b.right > toast.left &&
        b.top < toast.bottom &&
        b.bottom > toast.top;
      const pressed = [...document.querySelectorAll("button, select, input")].filter((e) =>
        e.checkVisibility(),
      );
      return pressed
        .filter((e) => over(e.getBoundingClientRect()))
        .map((e) => e.id || e.textContent);
    });
    assert.deepEqual(covered, []);
    await page.click("#discard");
    assert.ok(await page.isDisabled("#apply"));
    await finish(page);
  });

  await test("Undo is there only while there is something to undo", async () => {
    const page = await open(`${url}#chairs`);
    for (let i = 0; i < 20 && (await page.isEnabled("#undo")); i++) {
      await page.click("#undo");
      await page.waitForSelector(".toast");
      await page.evaluate(() => document.querySelectorAll(".toast").forEach((t) => t.remove()));
    }
    await page.waitForSelector("#undo:disabled");
    assert.match(await page.getAttribute("#undo", "title"), /Nothing to undo/);
    assert.equal(coseg("show", "--collection", "chairs").n_undoable, 0);
    coseg(
      "name",
      String(coseg("show", "--collection", "chairs").labels[0].id),
      "first",
      "--collection",
      "chairs",
    );
    await page.waitForSelector("#undo:enabled");
    await page.click("#undo");
    await page.waitForSelector("#undo:disabled");
    coseg("wait", "--collection", "chairs");
    await finish(page);
  });

  await test("what is queued elsewhere is not counted here", async () => {
    const page = await open(`${url}#chairs`);
    const queue = { chairs: 0, candelabras: 7 };
    const isLibrary = (address) => address.pathname === "/api/library";
    await page.route(isLibrary, async (route) => {
      const response = await route.fetch();
      const library = await response.json();
      for (const c of library.collections) {
        assert.equal(typeof c.n_queued, "number");
        c.n_queued = queue[c.name] ?? 0;
      }
      await route.fulfill({ json: { ...library, n_queued: 7 + queue.chairs } });
    });
    for (let n = 0; n < 2; n++)
      await page.waitForResponse((response) => isLibrary(new URL(response.url())));
    assert.equal(await page.textContent("#state"), "live");
    queue.chairs = 3;
    await page.waitForFunction(() => document.querySelector("#state").textContent === "3 to place");
    await page.unrouteAll({ behavior: "ignoreErrors" });
    await finish(page);
  });

  for (const [kind, base] of [
    ["live", url],
    ["file", file],
  ])
    await test(`every view has an address, and Back and Forward go there: ${kind}`, async () => {
      const page = await open(`${base}#chairs`);
      await page.click(`.card[data-name="${first}"]`);
      await shown(page, first, "labels");
      await page.click("[data-mode=eigen]");
      await shown(page, first, "eigen");
      await page.locator("#controls input[type=range]").fill("4");
      await page.waitForFunction(() => location.hash.endsWith("/eigen/5"));
      await page.click(`.card[data-name="${second}"]`);
      await page.click("[data-mode=history]");
      await shown(page, second, "history");
      assert.match(await page.textContent(".log"), /added/);
      assert.equal(await page.locator(".part").count(), 0);
      for (const [name, view] of [
        [second, "eigen"],
        [first, "eigen"],
        [first, "labels"],
      ]) {
        await page.goBack();
        await shown(page, name, view);
      }
      await page.goBack();
      await page.waitForSelector("#stage", { state: "hidden" });
      assert.equal(await address(page), "#chairs");
      await page.goForward();
      await shown(page, first, "labels");
      await page.goForward();
      await shown(page, first, "eigen");
      assert.match(await page.textContent("#controls output"), /^5,/);
      await finish(page);
    });

  for (const [kind, base] of [
    ["live", url],
    ["file", file],
  ])
    await test(`a link leads to what it names, or says that it is not there: ${kind}`, async () => {
      const label = coseg("show", "--collection", "chairs").labels.find((l) => l.n_shapes > 0).id;
      const open1 = async (hash) => {
        const page = await open(base + hash);
        assert.equal(await page.isVisible("#gallery"), true);
        return page;
      };
      for (const view of VIEWS) {
        const page = await open1(`#chairs/${second}/${view}`);
        await shown(page, second, view);
        assert.equal(await page.getAttribute(`[data-mode=${view}]`, "aria-selected"), "true");
        await finish(page);
      }
      let page = await open1(`#chairs?search=${first}&order=name&label=${label}`);
      assert.equal(await page.inputValue("#search"), first);
      assert.equal(await page.inputValue("#order"), "name");
      assert.equal(await page.locator("#legend .chosen").count(), 1);
      assert.ok((await page.locator(".card").count()) <= 1);
      await finish(page);
      page = await open1("#chairs/no%20such%20shape/labels");
      assert.match(await page.textContent(".toast"), /no shape “no such shape” in chairs/);
      assert.equal(await address(page), "#chairs");
      await finish(page);
      page = await open1("#no%20such%20collection/x/map");
      assert.match(await page.textContent(".toast"), /no collection “no such collection”/);
      await finish(page);
      page = await open1(`#chairs/${first}/nonsense`);
      await shown(page, first, "labels");
      await page.evaluate(() => (location.hash = "#chairs/%E0%A4%A/labels"));
      await page.waitForSelector(".toast");
      await finish(page);
    });

  await test("a map that is poor says so, and neither shape is cut", async () => {
    const quality = (from, to) =>
      coseg("map", from, to, "--collection", "chairs").quality.confidence;
    const pairs = names.flatMap((a) =>
      names
        .slice(0, 4)
        .filter((b) => b !== a)
        .map((b) => [a, b, quality(a, b)]),
    );
    pairs.sort((a, b) => a[2] - b[2]);
    const [poor, good] = [pairs[0], pairs.at(-1)];
    assert.ok(poor[2] < 0.75 && good[2] > 0.75, `from ${poor[2]} to ${good[2]}`);
    for (const [width, height] of [
      [1440, 900],
      [900, 700],
      [420, 860],
    ])
      for (const [from, to, confidence] of [poor, good]) {
        const page = await open(`${url}#chairs/${to}/map/${from}`, { width, height });
        await shown(page, to, "map");
        await page.waitForSelector("canvas.heat");
        assert.equal(await page.inputValue("#controls select"), from);
        assert.equal(await page.isVisible("#advice"), confidence < 0.75);
        assert.match(await page.textContent("#captions"), /% right as expected/);
        // Two frames, for the room that the warning takes.
        await page.evaluate(
          () => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done))),
        );
        assert.deepEqual(
          await cut(page, 2),
          { sides: [], ends: [], any: true },
          `${width} ${from} ${to}`,
        );
        if (from === poor[0] && to === poor[1]) await shot(page, `poor-map-${width}`);
        await finish(page);
      }
  });

  await test("a search that finds nothing says no more than that", async () => {
    const page = await open(`${url}#chairs`);
    await page.fill("#search", "no such shape");
    assert.equal(await page.textContent("#empty"), "Nothing foundNo shape has this name or label.");
    await finish(page);
  });

  await test("an up axis that shapes do not stand along comes with a warning", async () => {
    const page = await open(`${url}#fallen`);
    assert.match(
      await page.textContent("#warning"),
      /given up -x.*coseg collections set fallen --up \+y/,
    );
    await shot(page, "fallen");
    coseg("collections", "set", "fallen", "--up", "+y");
    await page.waitForSelector("#warning", { state: "hidden" });
    await page.selectOption("#collections", "chairs");
    await page.waitForSelector(`.card[data-name="${first}"]`);
    assert.ok(await page.isHidden("#warning"));
    await page.goBack();
    await page.waitForFunction(() => document.querySelector("#collections").value === "fallen");
    await finish(page);
  });
}
