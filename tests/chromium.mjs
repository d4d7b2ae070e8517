// A real browser for tests of pages: Chromium, driven by playwright-core.

import { readFileSync } from "node:fs";
import { createRequire } from "node:module";

export const task = JSON.parse(readFileSync(process.argv[2], "utf8"));
const { chromium } = createRequire(task.modules)("playwright-core");
export const browser = await chromium.launch({
  executablePath: task.chromium,
  args: ["--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader", "--disable-quic", "--no-first-run", "--disable-sync",
    "--disable-background-networking", "--disable-component-update"],
});

// A new page, of a new person or a given context, whose errors and requests to other machines are kept.
export async function open(seen, height = 768, context = null) {
  const page = await (context ?? (await browser.newContext({ viewport: { width: 1366, height } }))).newPage();
  page.setDefaultTimeout(120000);
  page.on("pageerror", (error) => seen.errors.push(error.message));
  page.on("console", (message) => {
    // The log-in page asks whether it is needed, and is told so with a 401.
    if (message.type() !== "error" || message.text().includes("401")) return;
    seen.errors.push(`${message.text()} ${message.location().url}`);
  });
  page.on("request", (request) => {
    if (!/^(http:\/\/127\.0\.0\.1|file:|data:|blob:)/.test(request.url())) seen.outside.push(request.url());
  });
  return page;
}

let shots = 0;
// A picture of a page, where the task names a folder for pictures.
export const shoot = (page, name) =>
  task.shots && page.screenshot({ path: `${task.shots}/${String(++shots).padStart(2, "0")}_${name}.png` });

// Evaluate on a page; one that loads itself again in between is asked once more.
export const ask = (page, what) => page.evaluate(what).catch(() => page.waitForLoadState().then(() => page.evaluate(what)));

// Pictures of a page at three widths; how far it is wider than the window goes to seen.
export async function shootSizes(page, seen, name) {
  const before = page.viewportSize();
  for (const [width, height] of [[1440, 900], [1280, 720], [390, 844]]) {
    await page.setViewportSize({ width, height });
    await page.waitForTimeout(500);
    seen[`overflow_${name}_${width}`] = await ask(page, () => document.documentElement.scrollWidth - innerWidth);
    await shoot(page, `${name}_${width}`);
  }
  await page.setViewportSize(before);
  await page.waitForTimeout(500);
}

// The calibration page, of a camera with images of a size [px]: choose a marking by name, click roughly, or close up.
export async function clicking(page, size) {
  const box = await page.locator(".stage").boundingBox();
  const scale = Math.min(box.width / size[0], box.height / size[1]);
  const corner = [box.x + (box.width - scale * size[0]) / 2, box.y + (box.height - scale * size[1]) / 2];
  const middle = [box.x + box.width / 2, box.y + box.height / 2];
  const hundredth = (value) => Math.round(100 * value) / 100;
  const choose = (name) => page.locator(`[data-name="${name}"]`).first().dispatchEvent("click");
  const click = async ([x, y]) => {
    const rough = [Math.round(corner[0] + scale * x), Math.round(corner[1] + scale * y)];
    await page.mouse.click(...rough);
    return rough.map((value, k) => hundredth((value - corner[k]) / scale));
  };
  // Roughly in the whole picture, then close up.
  const place = async (name, at) => {
    await choose(name);
    const rough = await click(at);
    await page.keyboard.press("z");
    for (let k = 0; k < 3; k++) await page.keyboard.press("+");
    await page.mouse.move(...middle);
    await page.mouse.down();
    await page.mouse.move(...at.map((value, k) => middle[k] + 6 * 1.4 ** 3 * (value - rough[k])), { steps: 3 });
    await page.mouse.up();
    await page.keyboard.press("0");
  };
  const saved = () => page.waitForSelector('[data-state="saved"]', { timeout: 60000 });
  return { middle, choose, click, place, saved };
}

// Log in to the review pages.
export async function logIn(page, base, who) {
  await page.goto(`${base}/login#token=${task.token}`);
  await page.fill("#who", who);
  await page.click("button");
  await page.waitForSelector("li.panel");
}

// What was seen goes to the test.
export async function tell(seen) {
  console.log(JSON.stringify(seen));
  await browser.close();
}
