// Mends people on the review pages as a person would; prints what it saw as one JSON object.

import { logIn, open, shoot, task, tell } from "../chromium.mjs";

const seen = { errors: [], outside: [], states: [] };
const page = await open(seen);
const shot = (name) => shoot(page, name);
const match = encodeURIComponent(task.match);

await logIn(page, task.base, "Ada");

if (task.mends) await mend();
else await approve();
await tell(seen);

async function mend() {
  // Two people who change places: split where they do, then each is joined with their own end.
  await page.goto(`${task.base}/#/identities/${match}/clip`); // the former address leads to the page of the match
  const [one, other, tail] = task.swapped;
  const row = (id) => page.locator(`[data-person="${id}"]`);
  await row(one).click();
  await page.locator("[data-scene=ready]").waitFor();
  await page.locator("[data-scrub]").fill(String(task.middle));
  await row(one).click({ position: { x: 20, y: 10 } });
  await shot("identities");
  const before = await page.locator("[data-person]").evaluateAll((rows) => rows.map((each) => each.dataset.person));
  const isSaid = (text) => page.waitForSelector(`[role=status] >> text=${text}`);
  await page.locator("body").press("s");
  await isSaid("is another person from frame");
  await page.waitForFunction((count) => document.querySelectorAll("[data-person]").length > count, before.length);
  const after = await page.locator("[data-person]").evaluateAll((rows) => rows.map((each) => each.dataset.person));
  const [end] = after.filter((id) => !before.includes(id));
  for (const [kept, merged] of [[one, tail], [other, end]]) {
    await row(kept).click({ position: { x: 20, y: 10 } });
    await row(merged).click({ modifiers: ["Shift"], position: { x: 20, y: 10 } });
    await page.locator("body").press("m");
    await row(merged).waitFor({ state: "detached" });
}

// A keypoint that the other cameras contradict is put where they expect it.
const { camera, frame, detection, joint } = task.keypoint;
await page.goto(`${task.base}/#/detections/${match}/${camera}?frame=${frame}`);
await page.locator("[data-scene=ready]").waitFor();
await page.click("[data-edit]");
const keypoint = page.locator(`[data-keypoint="${detection}.${joint}"]`);
await keypoint.waitFor();
await keypoint.click({ force: true });
await page.waitForSelector("[data-error-here]");
await page.waitForSelector("[data-curve]");
const error = async () => Number.parseFloat(await page.locator("[data-error-here]").textContent());
seen.error = await error();
seen.curves = await page.locator("[data-here]").count();
await shot("detections");
await page.locator("body").press("e");
await page.waitForSelector('[data-kept="1"]');
for (let k = 0; k < 100 && (await error()) > 5; k++) await page.waitForTimeout(200);
seen.mended = await error();
await shot("mended");

}

// Whatever waits is approved; the run goes on by itself until it is complete.
async function approve() {
  await page.goto(`${task.base}/#/match/${match}`);
  const limit = Date.now() + 1000 * task.patience;
  while (Date.now() < limit) {
    const state = await (await page.request.get(`${task.base}/api/matches/${match}`)).json();
    const now = state.at_work?.state === "running" ? "running" : (state.run?.state ?? "not run");
    if (seen.states.at(-1) !== now) seen.states.push(now);
    if (now === "complete" || now === "failed" || now === "partial") break;
    if (now === "waiting" && state.waiting.length) {
      await page.locator("button.first >> text=Approve").first().waitFor();
      await page.locator("body").press("a");
    }
    await page.waitForTimeout(1500);
}
await shot("approved");
}
