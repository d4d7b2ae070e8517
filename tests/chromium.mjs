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

// A new page, whose errors and requests to other machines are kept.
export async function open(seen, height = 768) {
  const page = await browser.newPage({ viewport: { width: 1366, height } });
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
