// Drives the review pages as a person would; prints what it saw as one JSON object.

import { clicking, logIn, open, shoot, task, tell } from "../chromium.mjs";

const seen = { errors: [], outside: [], states: [] };
const page = await open(seen);
const shot = (name) => shoot(page, name);
const match = encodeURIComponent(task.match);

await logIn(page, task.base, task.who);
await shot("queue");

// The camera that nobody clicked, from the queue by the way a person takes.
await page.click(`a.name[href="#/match/${match}"]`);
await page.click(`[data-now=calibrate] a >> text=${task.camera}`);
await page.waitForSelector(".stage canvas");
await shot("nothing");
const { middle, choose, click, place, saved } = await clicking(page, task.size);
for (const [name, at] of Object.entries(task.points)) await place(name, at);
for (const [name, places] of Object.entries(task.lines)) {
  await choose(name);
  for (const at of places) await click(at);
}
await saved();
await page.waitForSelector('[data-figure="lines"]', { timeout: 60000 });
seen.figures = await page.locator("[data-figure]").allTextContents();
await shot("calibrated");

// One mark is dragged about: each move is a camera.
await page.evaluate(() => performance.clearMeasures("preview"));
await choose(task.dragged);
await page.keyboard.press("z");
await page.mouse.move(...middle);
await page.mouse.down();
for (let k = 1; k <= 40; k++) {
  await page.mouse.move(middle[0] + 2 * Math.sin(k / 3) + k / 2, middle[1] + k / 3, { steps: 1 });
  await page.waitForTimeout(60);
}
await shot("dragging");
await page.mouse.up();
await saved();
seen.previews = await page.evaluate(() => performance.getEntriesByName("preview").map((each) => each.duration));
// Undone, redone, nudged there and back, undone: it is where it was.
await page.keyboard.press("Control+z");
await page.keyboard.press("Control+y");
await page.keyboard.press("Control+z");
await page.keyboard.press("ArrowLeft");
await page.keyboard.press("Shift+ArrowUp");
await page.keyboard.press("Alt+ArrowDown");
await page.waitForTimeout(900);
await page.keyboard.press("Control+z");
await page.keyboard.press("?");
await page.waitForSelector("dialog[open]");
await shot("help");
await page.keyboard.press("Escape");
await saved();

// The run, from its beginning; whatever it asks is approved until it is complete.
await page.click(`nav a >> text=${task.match}`);
// Whether the adjustment exceeds its limit depends on noise: here every result is asked about.
await page.route(/\/runs$/, (route) => route.continue({ postData: { ...route.request().postDataJSON(), gates: "always" } }));
await page.click("[data-now=new] button");
const end = Date.now() + 1000 * task.patience;
const now = async () => (await page.request.get(`${task.base}/api/matches/${match}`)).json();
const asked = (state) => state.waiting.map((each) => each.unit).join();
while (Date.now() < end) {
  const state = await now();
  const at = state.at_work?.state === "running" ? "running" : (state.run?.state ?? "not run");
  if (seen.states.at(-1) !== at) seen.states.push(at);
  if (at === "complete" || at === "failed" || at === "partial") break;
  if (at === "waiting" && state.waiting.length) {
    const approve = page.locator("button.first >> text=Approve").first();
    await approve.waitFor({ timeout: 30000 });
    if (seen.states.filter((each) => each === "waiting").length === 1) {
      await page.waitForSelector("figure img, .evidence p", { timeout: 60000 });
      await page.waitForLoadState("networkidle", { timeout: 5000 }).catch(() => {});
      await shot("question");
    }
    // What contradicts the adjustment the most is taken out with one key.
    if (!seen.out && state.waiting.some((each) => each.unit.startsWith("bundle_adjustment/"))) {
      await page.waitForSelector("[data-outlier]", { timeout: 60000 });
      await page.locator("body").press("x");
      await page.waitForSelector('[data-outlier="0"] >> text=✕ removed', { timeout: 60000 });
      seen.out = await page.locator('[data-outlier="0"] td').allTextContents();
      await shot("outliers");
      // The question needs no verdict now, and stays open for more corrections.
      await page.locator("article.open button >> text=Recompute").click();
      while (Date.now() < end && (await now()).at_work?.state !== "running") await page.waitForTimeout(250);
      continue;
    }
    await page.locator("body").press("a");
    // Until it is taken: one more would answer the next question unseen.
    while (Date.now() < end && asked(await now()) === asked(state)) {
      await page.waitForTimeout(250);
    }
  }
  await page.waitForTimeout(1500);
}
await shot("complete");
// A keypoint is put elsewhere, taken out, and that is taken back.
await page.goto(`${task.base}/#/detections/${match}/${encodeURIComponent(task.camera)}`);
await page.waitForSelector("[data-keypoint]", { timeout: 60000 });
await page.click("[data-edit]");
await page.keyboard.press("n");
const keypoint = page.locator("g.on [data-keypoint]").first();
const at = await keypoint.boundingBox();
seen.fixed = await keypoint.getAttribute("data-keypoint");
await page.mouse.move(at.x + at.width / 2, at.y + at.height / 2);
await page.mouse.down();
await page.mouse.move(at.x + 20, at.y + 12, { steps: 3 });
await page.mouse.up();
for (const [key, kept] of [[null, 1], ["Delete", 2], ["Control+z", 1]]) {
  if (key) await page.keyboard.press(key);
  await page.waitForSelector(`[data-kept="${kept}"]`, { timeout: 60000 });
}
await shot("detections");
await tell(seen);
