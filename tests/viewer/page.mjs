// Opens the viewer in headless Chromium, and counts the tests that pass.

import { execFileSync } from "node:child_process";
import { readFileSync } from "node:fs";
import { chromium } from "playwright-core";

/** Runs coseg, and returns what it prints as JSON. COSEG_BIN and COSEG_ENDPOINT are set. */
export function coseg(...args) {
  const all = [...args, "--json", "--timeout", "60"];
  return JSON.parse(execFileSync(process.env.COSEG_BIN, all, { encoding: "utf8" }));
}

export const launch = () =>
  chromium.launch({
    executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium",
    // As on any machine without a graphics card; WebGL is emulated, which has to be allowed.
    args: ["--no-sandbox", "--enable-unsafe-swiftshader"],
  });

/**
 * With COSEG_VIEWER_SOURCES, a folder as src/viewer, a live page has its sources instead of those
 * in the binary, so that they are tried without a build.
 */
async function fromSources(page, url) {
  const folder = process.env.COSEG_VIEWER_SOURCES;
  if (!folder) return;
  const read = (name) => readFileSync(`${folder}/${name}`, "utf8");
  const scripts = [...read("page.rs").matchAll(/include_str!\("(page\/\w+\.js)"\)/g)];
  const script = () => scripts.map((found) => read(found[1])).join("\n");
  const frame = () =>
    read("page/page.html")
      .replace("<!--style-->", '<link rel="stylesheet" href="viewer.css">')
      .replace("<!--data-->", "")
      .replace("<!--script-->", '<script type="module" src="viewer.js"></script>');
  const served = {
    "": ["text/html", frame],
    "viewer.css": ["text/css", () => read("page/style.css")],
    "viewer.js": ["text/javascript", script],
  };
  for (const [path, [contentType, body]] of Object.entries(served))
    await page.route(url + path, (route) => route.fulfill({ contentType, body: body() }));
}

/**
 * Returns a function that opens a page. The page notes as `faults` whatever goes wrong in it, and
 * whatever else it asks for.
 */
export function opener(browser, url) {
  return async (address, { theme = "light", width = 1440, height = 900 } = {}) => {
    const context = await browser.newContext({ viewport: { width, height }, colorScheme: theme });
    const page = await context.newPage();
    page.setDefaultTimeout(Number(process.env.COSEG_VIEWER_PATIENCE_MS ?? 90_000));
    page.faults = [];
    page.on("console", (message) => {
      const { url: from } = message.location();
      // The page asks again if the daemon had no room for a read.
      const isBusy = /status of 503/.test(message.text());
      if (message.type() === "error" && !isBusy) page.faults.push(`${message.text()} ${from}`);
    });
    page.on("pageerror", (error) => page.faults.push(String(error)));
    page.on("dialog", (dialog) => dialog.accept());
    page.on("request", (request) => {
      const target = request.url();
      const own = [url, "file:", "data:"].some((begin) => target.startsWith(begin));
      if (!own) page.faults.push(`asked for ${target}`);
    });
    await fromSources(page, url);
    await page.goto(address);
    await page.waitForSelector("html[data-ready]", { timeout: 60_000 });
    return page;
  };
}

/** Tests, one after the other; a test that fails does not end the others. */
export class Tests {
  passed = 0;
  failed = 0;
  /** Runs a test whose name contains COSEG_VIEWER_ONLY, if that is set. */
  test = async (name, work) => {
    if (!name.includes(process.env.COSEG_VIEWER_ONLY ?? "")) return;
    try {
      await work();
      this.passed += 1;
      console.log(`ok   ${name}`);
    } catch (error) {
      this.failed += 1;
      console.log(`FAIL ${name}\n${error.stack ?? error}`);
    }
  };
}

/** Distinct colours of a canvas, coarsely; one or two mean that nothing was drawn. */
export const colours = (page, selector) =>
  page.$eval(selector, (canvas) => {
    const copy = document.createElement("canvas");
    [copy.width, copy.height] = [canvas.width, canvas.height];
    const context = copy.getContext("2d");
    context.drawImage(canvas, 0, 0);
    const { data } = context.getImageData(0, 0, copy.width, copy.height);
    const seen = new Set();
    for (let i = 0; i < data.length; i += 4)
      seen.add(`${data[i] >> 5} ${data[i + 1] >> 5} ${data[i + 2] >> 5}`);
    return seen.size;
  });

export const shown = (page, name, view) =>
  page.waitForSelector(`#stage[data-shown="${name} ${view}"]`);

export async function select(page, name) {
  await page.click(`.card[data-name="${name}"]`);
  await shown(page, name, "labels");
}

export async function mode(page, name, wanted) {
  await page.click(`[data-mode=${wanted}]`);
  await shown(page, name, wanted);
}

/** Waits for a message that begins like this, and takes all messages away. */
export async function toast(page, begin) {
  await page.waitForFunction(
    (begin) =>
      [...document.querySelectorAll(".toast")].some((t) => t.textContent.startsWith(begin)),
    begin,
  );
  await page.evaluate(() => document.querySelectorAll(".toast").forEach((t) => t.remove()));
}
