// Puts pictures of a session beside each other on one sheet.

import { readFileSync } from "node:fs";

const WIDTH = 440;
const COLUMNS = 3;

/** Writes `session.png`: the pictures of the steps that are marked, each with its time below. */
export async function sheet(browser, out, steps) {
  const shown = steps.filter((s) => s.onSheet);
  const page = await browser.newPage({
    viewport: { width: COLUMNS * (WIDTH + 16) + 16, height: 600 },
  });
  const figure = (s) => {
    const data = readFileSync(`${out}/${s.picture}`).toString("base64");
    const text = `<b>${s.seconds.toFixed(0)} s</b> ${s.what} <i>${s.accuracy.toFixed(3)}</i>`;
    const image = `<img src="data:image/png;base64,${data}">`;
    return `<figure>${image}<figcaption>${text}</figcaption></figure>`;
  };
  await page.setContent(`<style>
    body { margin: 16px 0 0 16px; display: flex; flex-wrap: wrap; gap: 16px; background: #fff; }
    figure { margin: 0; width: ${WIDTH}px; font: 14px/1.4 "DejaVu Sans", sans-serif; }
    img { width: 100%; display: block; border: 1px solid #ccd; }
    figcaption { margin-top: 5px; } i { float: right; font-style: normal; font-weight: bold; }
    </style>${shown.map(figure).join("")}`);
  await page.waitForFunction(() => [...document.images].every((image) => image.complete));
  await page.screenshot({ path: `${out}/session.png`, fullPage: true });
  await page.close();
}
