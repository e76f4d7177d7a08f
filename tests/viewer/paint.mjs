// Painting in the viewer by mouse and by keyboard: what is sent is what the daemon has.

import assert from "node:assert/strict";
import { coseg, mode, select, shown, toast } from "./page.mjs";

const C = "chairs";

const of = (name) => coseg("labels", name, "--collection", C).labels;
const settled = () => coseg("wait", "--collection", C);
/** Number of painted faces, as the page says. */
const painted = (page) =>
  page.$eval("#amount", (e) =>
    Number(/^([\d,]+) face/.exec(e.textContent)?.[1].replace(",", "") ?? 0),
  );

/** Presses the mouse at places along a line through the middle; some are on the shape. */
async function strokes(page, places = 12) {
  const box = await page.locator("#scene").boundingBox();
  for (let i = 0; i <= places; i++) {
    await page.mouse.move(box.x + box.width / 2, box.y + box.height * (0.2 + (0.6 * i) / places));
    await page.mouse.down();
    await page.mouse.up();
  }
}

/** Finds a place of the page where the shape is. */
async function place(page) {
  const box = await page.locator("#scene").boundingBox();
  for (let i = 0; i <= 12; i++) {
    const at = [box.x + box.width / 2, box.y + box.height * (0.2 + i * 0.05)];
    await page.mouse.move(...at);
    if (await page.isVisible("#hint")) return at;
  }
  throw new Error("the shape is nowhere in the middle");
}

/** Applies what is painted, and checks that the daemon has these faces as they were painted. */
async function applied(page, shape, label, apply) {
  const n = await painted(page);
  const [sent] = await Promise.all([page.waitForRequest("**/api/correct"), apply()]);
  await toast(page, "");
  const { runs } = sent.postDataJSON();
  const faces = runs.flatMap(([first, count]) =>
    Array.from({ length: count }, (_, i) => first + i),
  );
  assert.equal(faces.length, n, "what is sent is what the page counts");
  const after = of(shape);
  assert.ok(runs.every((run) => run[2] === label) && faces.every((f) => after[f] === label));
}

export async function paintTests({ test, open, shot, url, names }) {
  const [first] = names;
  const finish = async (page) => {
    assert.deepEqual(page.faults, []);
    await page.context().close();
  };
  const correcting = async () => {
    const page = await open(`${url}#${C}`);
    await select(page, first);
    await mode(page, first, "correct");
    return page;
  };
  const undo = async (page, before) => {
    settled();
    await page.click("#undo");
    await toast(page, `Undone: the correction of ${first}`);
    settled();
    assert.deepEqual(of(first), before);
  };

  await test("a painted correction is sent, carried and undone", async () => {
    const page = await correcting();
    const before = of(first);
    const chosen = Number(await page.getAttribute(".palette button:last-child", "data-label"));
    await page.click(".palette button:last-child");
    assert.ok(await page.isDisabled("#apply"));
    await strokes(page);
    assert.ok(await page.isEnabled("#apply"));
    await shot(page, "correct");
    assert.ok(!before.includes(chosen));
    await applied(page, first, chosen, () => page.click("#apply"));
    await undo(page, before);
    await finish(page);
  });

  for (const way of ["mouse", "keyboard"])
    await test(`strokes are undone and done again, erased and discarded: by ${way}`, async () => {
      const page = await correcting();
      const press = (id, key) => (way === "mouse" ? page.click(id) : page.keyboard.press(key));
      await page.focus("#scene");
      await press(".palette button:nth-child(2)", "2");
      assert.equal(await page.getAttribute(".palette button:nth-child(2)", "aria-pressed"), "true");
      const n = coseg("show", "--collection", C).n_undoable;
      await strokes(page);
      const all = await painted(page);
      assert.ok(all > 0);
      await press("#undo", "Control+z");
      const less = await painted(page);
      assert.ok(less < all, `${less} of ${all} faces after undo`);
      await press("#redo", "Control+Shift+z");
      assert.equal(await painted(page), all);
      await press("[data-tool=eraser]", "e");
      await strokes(page);
      assert.equal(await painted(page), 0);
      await press("#undo", "Control+z");
      const some = await painted(page);
      assert.ok(some > 0, "erasing is a stroke too");
      await shot(page, `strokes-${way}`);
      if (way === "mouse") await page.click("#discard");
      else {
        await page.focus("#discard");
        await page.keyboard.press("Enter");
      }
      assert.equal(await painted(page), 0);
      await press("#undo", "Control+z");
      assert.equal(await painted(page), some, "what was discarded comes back");
      await page.click("#discard");
      assert.equal(coseg("show", "--collection", C).n_undoable, n, "nothing was sent or undone");
      await finish(page);
    });

  await test("the cursor shows the size of the brush; keys and slider change it", async () => {
    const page = await correcting();
    const at = await place(page);
    const size = async () => {
      await page.mouse.move(at[0] + 1, at[1]);
      await page.mouse.move(...at);
      const box = await page.locator("#cursor").boundingBox();
      return { across: box.width, x: box.x + box.width / 2, y: box.y + box.height / 2 };
    };
    const one = await size();
    assert.ok(Math.hypot(one.x - at[0], one.y - at[1]) < 2, "the cursor is at the pointer");
    await page.focus("#scene");
    await page.keyboard.press("]");
    const two = await size();
    assert.ok(Math.abs(two.across / one.across - 1.25) < 0.05, `${one.across} to ${two.across}`);
    await page.mouse.down();
    await page.mouse.up();
    const wide = await painted(page);
    await page.keyboard.press("Control+z");
    for (let i = 0; i < 4; i++) await page.keyboard.press("[");
    assert.ok((await size()).across < one.across);
    await page.mouse.down();
    await page.mouse.up();
    assert.ok((await painted(page)) < wide, "a smaller brush paints less");
    await page.locator("#controls input[type=range]").fill("0.5");
    assert.ok((await size()).across > 2 * two.across);
    await page.keyboard.press("Control+z");
    await page.focus("#scene");
    await page.keyboard.press("Control+z");
    assert.equal(await painted(page), 0);
    await finish(page);
  });

  for (const way of ["mouse", "keyboard"])
    await test(`a part is filled by a click, and applied: by ${way}`, async () => {
      const page = await correcting();
      const before = of(first);
      const fresh = Number(await page.getAttribute(".palette button:last-child", "data-label"));
      if (way === "mouse") {
        await page.click("[data-tool=part]");
        await page.click(".palette button:last-child");
        await page.mouse.click(...(await place(page)));
      } else {
        await page.focus("#scene");
        await page.keyboard.press("f");
        const n = await page.locator(".palette button").count();
        assert.ok(n < 10);
        await page.keyboard.press(String(n));
        // The arrows move the cursor from the middle until it is on the shape.
        for (let i = 0; i < 40 && (await painted(page)) === 0; i++) {
          await page.keyboard.press(i % 2 ? "ArrowDown" : "ArrowRight");
          await page.keyboard.press("Space");
        }
        assert.ok(await page.isVisible("#cursor"));
        assert.match(await page.textContent("#spoken"), /painted/);
        assert.ok(page.url().includes(`${first}/correct`), "the arrows stay on this shape");
      }
      await shot(page, `fill-${way}`);
      const apply = () => (way === "mouse" ? page.click("#apply") : page.keyboard.press("Enter"));
      await applied(page, first, fresh, apply);
      await undo(page, before);
      await finish(page);
    });

  await test("a brush moved by keys paints where it is, and turning is not painting", async () => {
    const page = await correcting();
    const before = of(first);
    await page.focus("#scene");
    const scene = () => page.$eval("#scene", (c) => c.toDataURL());
    const still = await scene();
    await page.keyboard.press("Shift+ArrowLeft");
    await page.waitForFunction((s) => document.querySelector("#scene").toDataURL() !== s, still);
    assert.equal(await painted(page), 0);
    await page.keyboard.press("b");
    const n = await page.locator(".palette button").count();
    await page.keyboard.press(String(n));
    const label = Number(await page.getAttribute(".palette button:last-child", "data-label"));
    const places = [];
    for (let i = 0; i < 40 && places.length < 3; i++) {
      await page.keyboard.press(i % 2 ? "ArrowDown" : "ArrowRight");
      const was = await painted(page);
      await page.keyboard.press("Space");
      if ((await painted(page)) > was) places.push(await page.locator("#cursor").boundingBox());
    }
    assert.equal(places.length, 3);
    assert.ok(places[0].x !== places[2].x || places[0].y !== places[2].y, "the cursor moved");
    const all = await painted(page);
    await page.keyboard.press("Control+z");
    assert.ok((await painted(page)) < all);
    await page.keyboard.press("Control+Shift+z");
    await applied(page, first, label, () => page.keyboard.press("Enter"));
    await undo(page, before);
    await shown(page, first, "correct");
    await finish(page);
  });
}
