// First paint of the pages of a project with many matches and corrections; prints it as one JSON object.

import { logIn, open, shoot, task, tell } from "../chromium.mjs";

const seen = { errors: [], outside: [], paint: {}, shown: {} };
const page = await open(seen, 900);
await logIn(page, task.base, "Ada");
// A page that loads itself again in between is asked once more.
const ask = (what) => page.evaluate(what).catch(() => page.waitForLoadState().then(() => page.evaluate(what)));
const places = {
  text: ["/login/page.css", "pre"],
  queue: ["/", "li.panel"],
  match: [`/#/match/${encodeURIComponent(task.match)}`, "[data-group]"],
  status: ["/status", "table"],
};
for (const [name, [path, selector]] of Object.entries(places)) {
  await page.goto("about:blank");
  const begun = Date.now();
  await page.goto(`${task.base}${path}`);
  await page.waitForSelector(selector);
  seen.errors = seen.errors.filter((text) => !text.includes("favicon"));
  seen.shown[name] = (Date.now() - begun) / 1000;
  seen.paint[name] = await ask(() => performance.getEntriesByName("first-contentful-paint")[0].startTime / 1000);
  for (const [width, height] of [[1440, 900], [1280, 720], [390, 844]]) {
    await page.setViewportSize({ width, height });
    await page.waitForTimeout(300);
    seen[`overflow_${name}_${width}`] = await ask(() => document.documentElement.scrollWidth - innerWidth);
    await shoot(page, `${name}_${width}`);
  }
  await page.setViewportSize({ width: 1366, height: 900 });
}
// All matches are there after some requests, each of which reads a part of them.
await page.goto("about:blank").catch(() => page.goto("about:blank")); // the status page loads itself again
await page.goto(`${task.base}/`);
await page.waitForFunction((count) => document.querySelectorAll("li.panel > a.name").length === count, task.count);
await page.waitForFunction(() => ![...document.querySelectorAll(".state")].some((each) => each.textContent.includes("being read")));
await tell(seen);
