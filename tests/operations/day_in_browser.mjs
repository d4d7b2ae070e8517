// An operator's day on the pages: a match from videos, its calibration, run, corrections, results and schedule. Prints what
// was seen as one JSON object.

import { clicking, open, shoot, shootSizes, task, tell } from "../chromium.mjs";

const seen = { errors: [], outside: [], states: [] };
const page = await open(seen, 900);
page.on("dialog", (dialog) => dialog.accept());
const match = encodeURIComponent(task.match);
const matchPage = `${task.pages}/#/match/${match}`;
const state = async () => (await page.request.get(`${task.pages}/api/matches/${match}`)).json();
const settled = () => page.waitForLoadState("networkidle", { timeout: 5000 }).catch(() => {});
const until = async (what, isSo) => {
  for (const end = Date.now() + 1000 * task.patience; !(await isSo()); ) {
    if (Date.now() > end) throw new Error(`waited for ${what} in vain`);
    await page.waitForTimeout(1000);
  }
};

const STEPS = [create, calibrate, answer, correct, complete, mend, watch, download, schedule, leave];

await page.goto(`${task.pages}/login#token=${task.token}`);
await shootSizes(page, seen, "login");
await page.fill("#who", "Ada");
await page.click("button");
await page.waitForSelector("[data-create]");
for (const step of STEPS) await step();
await tell(seen);

// A match from the videos of a folder that the operator named.
async function create() {
  await page.waitForSelector("text=No match is registered");
  await shootSizes(page, seen, "empty");
  await page.click("[data-create]");
  await page.click("text=Pick videos on the server");
  await page.click("text=/^Pick all/");
  await page.waitForFunction((count) => document.querySelectorAll("dialog .soft").length && [...document.querySelectorAll("dialog .soft")].filter((each) => each.textContent.includes("picked")).length === count, task.videos);
  await page.click("dialog >> text=Close");
  await page.setInputFiles("[data-upload]", task.pitch);
  await page.waitForFunction((count) => document.querySelectorAll('li[data-state="ready"]').length === count, task.videos + 1);
  await page.click("text=/^Add cameras for/");
  await page.fill('[data-field="match_id"]', task.match);
  await page.click("[data-offsets]");
  await page.waitForFunction(() => [...document.querySelectorAll("dialog img")].every((each) => each.naturalWidth));
  await shootSizes(page, seen, "offsets");
  await page.click("[data-use]");
  await page.click("text=Paste a list");
  await page.fill("[data-paste]", "kane; Harry Kane; England");
  await page.click("text=Add these people");
  await page.waitForSelector("text=Nothing is missing");
  await page.waitForSelector('[data-saving="saved"]');
  await shootSizes(page, seen, "create");
  await page.click("[data-finish]");
  await page.waitForSelector(`a.name[href="#/match/${match}"]`, { timeout: 1000 * task.patience });
  await shootSizes(page, seen, "queue");
}

// Every camera is clicked, one of them with a wrong click.
async function calibrate() {
  await page.click(`a.name[href="#/match/${match}"]`);
  await page.waitForSelector("[data-now=calibrate]");
  await settled();
  await shootSizes(page, seen, "to_click");
  for (const [camera, points] of Object.entries(task.clicks)) {
    await page.goto(matchPage);
    await page.click(`[data-now=calibrate] a >> text=${camera}`);
    await page.waitForSelector(".stage canvas");
    const hand = await clicking(page, task.size);
    for (const [name, at] of Object.entries(points)) await hand.place(name, at);
    await hand.saved();
    await page.waitForSelector("[data-figure]", { timeout: 60000 });
  }
  await shootSizes(page, seen, "calibrated");
  await page.goto(matchPage);
}

// The run asks about the camera with the wrong click.
async function answer() {
  await page.goto(matchPage);
  await page.click("[data-now=new] button");
  await page.waitForSelector("[data-now=running]");
  await shootSizes(page, seen, "running");
  await until("a question", async () => (await state()).waiting.length > 0 && (await state()).at_work?.state !== "running");
  seen.asked = (await state()).waiting.map((each) => each.unit);
  await page.waitForSelector(".evidence figure img", { timeout: 120000 });
  await settled();
  seen.blank = await page.evaluate(() => [...document.querySelectorAll(".evidence img")].filter((each) => !each.naturalWidth).length);
  await shootSizes(page, seen, "question");
}

// The wrong click is taken out; the question needs no verdict, and the match is out of date.
async function correct() {
  await page.goto(matchPage);
  await page.click("text=Correct its clicks");
  await page.waitForSelector("[data-figure]", { timeout: 60000 });
  await page.locator("body").press("n");
  await shoot(page, "worst");
  await page.locator("body").press("Delete");
  await page.waitForSelector('[data-state="saved"]', { timeout: 60000 });
  await page.waitForTimeout(1500);
  await page.goto(matchPage);
  await page.waitForSelector("text=Corrected, will be computed again");
  await shootSizes(page, seen, "corrected");
  await again();
}

// Run again what is out of date.
async function again() {
  const last = (await state()).run.id;
  await page.click("[data-now=outdated] button");
  await until("the next run", async () => (await state()).run.id !== last || (await state()).at_work?.state === "running");
}

// Whatever else waits is approved, until the run is complete.
async function complete() {
  await page.goto(matchPage);
  await until("a complete run", async () => {
    const now = await state();
    const at = now.at_work?.state === "running" ? "running" : now.run?.state;
    if (seen.states.at(-1) !== at) seen.states.push(at);
    if (at === "failed") throw new Error(`the run failed: ${JSON.stringify(now.failures)}`);
    if (at === "waiting" && now.waiting.some((each) => !each.rejected)) {
      await page.locator("button.first >> text=Approve").first().click();
      await page.waitForTimeout(1500);
    }
    return at === "complete";
  });
  await page.waitForSelector('[data-scene="ready"]');
  await settled();
  await shootSizes(page, seen, `complete_${seen.states.length}`);
}

// A person is split and joined again, and gets a name; the run applies it.
async function mend() {
  await page.goto(`${task.pages}/#/identities/${match}/clip`);
  await page.waitForSelector("[data-person]");
  const people = () => page.locator("[data-person]").evaluateAll((rows) => rows.map((each) => each.dataset.person));
  const before = await people();
  await page.locator("[data-scene=ready]").waitFor();
  await page.locator("[data-scrub]").fill("5");
  const row = (id, more = {}) => page.locator(`[data-person="${id}"]`).click({ position: { x: 60, y: 10 }, ...more });
  await row(before[0]);
  await page.waitForFunction(() => document.querySelector(".crops img")?.naturalWidth);
  await shootSizes(page, seen, "identities");
  await page.locator("body").press("s");
  await page.waitForFunction((count) => document.querySelectorAll("[data-person]").length > count, before.length);
  const [end] = (await people()).filter((id) => !before.includes(id));
  await row(before[0]);
  await row(end, { modifiers: ["Shift"] });
  await page.locator("body").press("m");
  await page.locator(`[data-person="${end}"]`).waitFor({ state: "detached" });
  await row(before[0]);
  await page.locator("body").press("n");
  await page.keyboard.type("kane");
  await page.keyboard.press("Enter");
  await page.waitForSelector(".row >> text=Harry Kane");
  await page.goto(matchPage);
  await again();
  await complete();
}

// The result plays in 3D next to the video.
async function watch() {
  await page.goto(matchPage);
  await page.waitForSelector('[data-scene="ready"]');
  seen.named = await page.locator(".people button >> text=Harry Kane").count();
  await page.click("[data-watch]");
  await page.waitForFunction(() => document.querySelector("video")?.readyState >= 2, null, { timeout: 1000 * task.patience });
  await page.locator("[data-scrub]").fill("6");
  await page.waitForFunction(() => Math.abs(document.querySelector("video").currentTime - 6 / 25) < 0.021);
  seen.video_s = await page.evaluate(() => document.querySelector("video").currentTime);
  await page.locator("[data-scrub]").scrollIntoViewIfNeeded();
  await shootSizes(page, seen, "watch");
  await page.click("[data-play]");
  await page.waitForTimeout(1000);
  await page.click("text=Metrics per camera");
  await page.waitForSelector('[data-metrics="player"] td');
  await page.locator('[data-metrics="player"]').scrollIntoViewIfNeeded();
  await shootSizes(page, seen, "metrics");
}

async function download() {
  await page.goto(`${task.pages}/#/results/${match}/clip`);
  await page.waitForSelector("[data-downloads] a");
  const asked = page.waitForEvent("download", { timeout: 1000 * task.patience });
  await page.click("[data-downloads] a >> text=/^joints$/");
  await (await asked).saveAs(task.saved);
}

// Every night, what has become stale is computed again: Prefect's own page has the schedule.
async function schedule() {
  await page.goto(`${task.pages}/status`);
  await page.waitForSelector(`text=${task.match}`);
  await shootSizes(page, seen, "status");
  await readHelp();
  const prefect = await open({ errors: [], outside: seen.outside }, undefined, page.context());
  await prefect.goto(`${task.prefect}/deployments`);
  await prefect.getByRole("row").filter({ hasText: "reprocess" }).getByRole("link").first().click();
  await prefect.waitForURL(/deployment\/[-0-9a-f]+/);
  await prefect.waitForTimeout(3000);
  await shoot(prefect, "reprocess");
  await prefect.getByRole("button", { name: "Schedule", exact: true }).click();
  await prefect.getByText("Cron", { exact: true }).click();
  await prefect.locator('xpath=//label[normalize-space()="Value"]/following::input[1]').fill("0 3 * * *");
  await shoot(prefect, "schedule");
  const answering = prefect.waitForResponse((each) => each.request().method() === "POST" && /\/schedules$/.test(each.url()));
  await prefect.getByRole("button", { name: "Save", exact: true }).click();
  const answer = await answering;
  if (!answer.ok()) throw new Error(`Prefect keeps no schedule: ${answer.status()} ${await answer.text()}`);
  await prefect.waitForSelector("text=/At 03:00/");
  await shoot(prefect, "scheduled");
}

// The status page explains its keys and states, and stays while they are read.
async function readHelp() {
  await page.waitForSelector("#leave:visible");
  await page.keyboard.press("?");
  await page.waitForSelector("dialog[open] >> text=blocked");
  await shoot(page, "status_help");
  await page.keyboard.press("Escape");
  await page.waitForSelector("dialog[open]", { state: "hidden" });
}

// Whoever logs out sees nothing more.
async function leave() {
  await page.goto(`${task.pages}/status`);
  await page.click("#leave");
  await page.waitForURL(/\/login$/);
  seen.left = (await page.request.get(`${task.pages}/status`, { maxRedirects: 0 })).status();
}
