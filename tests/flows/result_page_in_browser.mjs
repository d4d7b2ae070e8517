// Looks at the 3D view of a complete run; prints what it saw as one JSON object.

import { logIn, open, shoot, shootSizes, task, tell } from "../chromium.mjs";

const seen = { errors: [], outside: [] };
const page = await open(seen, 900);
await logIn(page, task.base, "Ada");
// The server is away while the view loads: the view comes when it answers again.
let refusals = 2;
await page.route(/\/scenes\/[^/]+$/, (route) => (refusals-- > 0 ? route.abort("connectionrefused") : route.continue()));
await page.goto(`${task.base}/#/match/${encodeURIComponent(task.match)}`);
await page.waitForSelector('[data-scene="ready"]');
const canvas = page.locator("[data-scene]");
await page.waitForTimeout(1500);
await canvas.screenshot({ path: task.picture });
await shootSizes(page, seen, "view");
await page.setViewportSize({ width: 1280, height: 720 });
seen.first = Number(await canvas.getAttribute("data-frame"));
await page.locator("[data-scrub]").fill("7");
await page.waitForFunction((first) => Number(document.querySelector("[data-scene]").dataset.frame) === first + 7, seen.first);
await page.keyboard.press("ArrowRight");
await page.click("[data-play]");
await page.waitForFunction((first) => Number(document.querySelector("[data-scene]").dataset.frame) !== first + 8, seen.first);
await page.click("[data-play]");
await page.locator("[data-scrub]").focus();
for (let k = 0; k < 4; k++) await page.keyboard.down("Space"); // held, it counts once
seen.held = await page.getAttribute("[data-play]", "aria-pressed");
await page.keyboard.up("Space");
await page.keyboard.press("Space");
await page.selectOption("[aria-label=Camera]", "cam00");
await page.waitForTimeout(500);
await shoot(page, "through_cam00");
await page.click(".people button >> nth=0");
await page.waitForTimeout(500);
await shoot(page, "follow");
// A download that cannot be written says why on this page.
await page.route("**/exports/bvh?*", (route) => route.fulfill({ status: 422, json: { error: "needs the extra usd" } }));
await page.click("[data-downloads] a >> text=/^bvh$/");
seen.refused = await page.locator("[role=alert] >> text=needs the extra").innerText();
seen.pages = page.context().pages().length;
await page.click("text=Dismiss");
seen.errors = seen.errors.filter((text) => !/422|ERR_CONNECTION_REFUSED/.test(text));
await page.click("text=Metrics per camera");
await page.waitForSelector('[data-metrics="player"] td');
seen.cameras = await page.locator('[data-metrics="camera"] tbody tr').count();
await page.locator('[data-metrics="player"]').scrollIntoViewIfNeeded();
await shoot(page, "metrics");
if (await page.locator("[data-watch]").count()) {
  await page.click("[data-watch]");
  await page.waitForFunction(() => document.querySelector("video")?.readyState >= 2);
  await page.locator("[data-scrub]").fill("20");
  await page.waitForTimeout(800);
  seen.video_s = await page.evaluate(() => document.querySelector("video").currentTime);
  await canvas.scrollIntoViewIfNeeded();
  await shoot(page, "video");
}
// The report has the same view, as the pages serve it and as a file; the wheel scrolls the report until the view is clicked.
seen.reports = [];
for (const address of [`${task.base}/api/matches/${encodeURIComponent(task.match)}/results/report`, `file://${task.report}`]) {
  await page.goto(address);
  const frame = page.frameLocator("iframe");
  await frame.locator('[data-scene="ready"]').waitFor();
  await page.locator("iframe").scrollIntoViewIfNeeded();
  await page.waitForTimeout(1500);
  const name = await frame.locator(".people button").count();
  const at = await frame.locator("[data-scene]").boundingBox();
  await page.mouse.move(at.x + at.width / 2, at.y + at.height / 2);
  const before = await page.evaluate(() => scrollY);
  await page.mouse.wheel(0, 120);
  await page.waitForTimeout(500);
  seen.reports.push([name, (await page.evaluate(() => scrollY)) - before]);
  await shootSizes(page, seen, "report");
}
await tell(seen);
