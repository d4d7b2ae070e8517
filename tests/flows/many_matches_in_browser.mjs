// First paint of the pages of a project with many matches and corrections; prints it as one JSON object.

import { ask, logIn, open, shootSizes, task, tell } from "../chromium.mjs";

const seen = { errors: [], outside: [], paint: {}, shown: {} };
const page = await open(seen, 900);
await logIn(page, task.base, "Ada");
const match = encodeURIComponent(task.match);
const places = {
  text: ["/login/page.css", "pre"],
  queue: ["/", "li.panel"],
  match: [`/#/match/${match}`, "[data-group]"],
  results: [`/#/results/${match}/clip`, '[data-scene="ready"]'],
  calibration: [`/#/picture/${match}/cam00`, "[data-figure]"],
  people: [`/#/detections/${match}/cam00`, "[data-keypoint]"],
  identities: [`/#/identities/${match}/clip`, "[data-person]"],
  status: ["/status", "main table"], // the last one, because it loads itself again
};
for (const [name, [path, selector]] of Object.entries(places)) {
  await page.goto("about:blank");
  const begun = Date.now();
  await page.goto(`${task.base}${path}`);
  await page.waitForSelector(selector);
  seen.errors = seen.errors.filter((text) => !text.includes("favicon"));
  seen.shown[name] = (Date.now() - begun) / 1000;
  // The first paint is written down a moment after it.
  await page.waitForFunction(() => performance.getEntriesByName("first-contentful-paint").length);
  seen.paint[name] = await ask(page, () => performance.getEntriesByName("first-contentful-paint")[0].startTime / 1000);
  await shootSizes(page, seen, name);
}
// All matches are there after some requests, each of which reads a part of them.
await page.goto("about:blank").catch(() => page.goto("about:blank")); // the status page loads itself again
await page.goto(`${task.base}/`);
await page.waitForSelector(`input[placeholder="Search ${task.count} matches"]`);
const areKnown = (count) => [...document.querySelectorAll("[data-filter] b")].reduce((sum, each) => sum + Number(each.textContent), 0) === count;
await page.waitForFunction(areKnown, task.count);
seen.rows = await page.locator("li.panel").count();
await page.fill("[aria-label=Search]", "copy017");
await page.waitForFunction(() => document.querySelectorAll("li.panel").length === 1);
seen.sought = await page.locator("li.panel a.name").innerText();
await tell(seen);
