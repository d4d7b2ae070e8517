// A person creates a match: uploads a video over a slow line while the server restarts and the page is loaded again, picks
// another one on the server, fills in the form, and puts the match into the inbox. Prints what it saw as one JSON object.

import { existsSync, writeFileSync } from "node:fs";
import { open, shoot, task, tell } from "../chromium.mjs";

const seen = { errors: [], outside: [] };
const page = await open(seen, 900);
page.on("dialog", (dialog) => dialog.accept());
await page.goto(`${task.base}/login#token=${task.token}`);
await page.fill("#who", "Ada");
await page.click("button");
await page.waitForSelector("[data-create]");
await page.waitForSelector("text=No match is registered");
seen.empty = await page.locator("main").innerText();
await shoot(page, "empty");

await page.click("[data-create]");
await page.waitForSelector("[data-missing]");
await shoot(page, "new");
seen.link = page.url();
const line = await page.context().newCDPSession(page);
const slow = (bytes) =>
  line.send("Network.emulateNetworkConditions", { offline: false, latency: 0, downloadThroughput: -1, uploadThroughput: bytes });
const percent = (least) =>
  page.waitForFunction((wanted) => {
    const bar = document.querySelector("progress");
    return bar && bar.value >= wanted * bar.max;
  }, least);

await slow(task.size / 12);
await page.setInputFiles("[data-upload]", task.video);
await percent(0.1);
await shoot(page, "uploading");
writeFileSync(`${task.signal}.restart`, ""); // the test restarts the server now
await page.waitForSelector("li[data-file] >> text=trying again");
await shoot(page, "waiting");
writeFileSync(`${task.signal}.seen`, "");
await percent(0.4);
seen.restarted = existsSync(`${task.signal}.restarted`);
await page.reload();
await page.waitForSelector("text=choose the same file again, and it continues");
seen.kept = await page.evaluate(() => document.querySelector("progress").value);
await shoot(page, "interrupted");
await slow(-1);
await page.setInputFiles("[data-upload]", task.video);
await page.waitForSelector('li[data-state="ready"]');

await page.click("text=Pick videos on the server");
await page.click("text=📁 day 1");
await page.waitForSelector("text=second.mp4");
await shoot(page, "picking");
await page.click("dialog li >> text=Pick");
await page.waitForSelector("text=✓ picked");
await page.click("dialog >> text=Close");
await page.waitForFunction(() => document.querySelectorAll('li[data-state="ready"]').length === 2);
await page.click("text=Add cameras for 2 videos");
await page.fill('[data-field="match_id"]', "cup/final");
await page.waitForSelector("label.wrong >> text=letters, digits");
seen.message = await page.locator("label.wrong .said").innerText();
await shoot(page, "wrong");
// A change while a slow save is under way is saved after it.
await page.route("**/form", async (route) => {
  await page.waitForTimeout(1500);
  await route.continue();
});
await page.fill('[data-field="match_id"]', "cup");
await page.waitForTimeout(900);
await page.fill('[data-field="match_id"]', "cup final");
seen.name = await page.inputValue('[data-field="match_id"]');
await page.waitForSelector('[data-saving="saved"]');
await page.unroute("**/form");
seen.refused = await page.locator("[data-again]").count();
await page.waitForSelector("text=Nothing is missing");
await page.locator("select[data-side]").first().selectOption("far");
await page.waitForSelector("text=Nothing is missing");

// One moment is frame 5 of the first video and frame 8 of the second: the second camera's clock offset is 3.
await page.click("[data-offsets]");
const frames = page.locator("dialog input[type=number]");
await frames.nth(0).fill("5");
await frames.nth(1).fill("8");
await page.waitForFunction(() => {
  const [one, other] = [...document.querySelectorAll("dialog img")];
  return one.src.endsWith("/5?fps=25") && other.src.endsWith("/8?fps=25") && one.naturalWidth && other.naturalWidth;
});
for (const [width, height] of [[1440, 900], [390, 844]]) {
  await page.setViewportSize({ width, height });
  seen[`overflow_dialog_${width}`] = await page.evaluate(() => document.querySelector("dialog").scrollWidth - document.querySelector("dialog").clientWidth);
  await shoot(page, `offsets_${width}`);
}
await page.setViewportSize({ width: 1366, height: 900 });
await page.click("dialog .look >> nth=1"); // close up, in all its pixels, and back
seen.close = await page.locator("dialog img").nth(1).getAttribute("src");
await page.click("dialog .look >> nth=1");
await page.click("[data-use]");

// A still of a camera, and a roster from a list.
await page.setInputFiles("[data-upload]", task.still);
await page.waitForSelector('li[data-file="first.png"][data-state="ready"]');
await page.locator("select[data-still]").first().selectOption("stills/first.png");
// Clicks of CVAT belong to the camera with whose name their file begins.
await page.setInputFiles("[data-upload]", task.clicks);
await page.waitForSelector('[data-notes] >> text="second_keypoints.xml: 1 clicks in second"');
await page.click("text=Paste a list");
seen.losing = [];
for (const list of ["kane, Harry Kane\nkane, Bob", "junk"]) {
  await page.fill("[data-paste]", list);
  await page.click("text=Add these people");
  seen.losing.push(await page.locator("section >> [role=alert].wrong").innerText());
}
await page.fill("[data-paste]", "ID;Name;Team;Role\nkane; Harry Kane; England\npickford\tPickford, Jordan\tEngland\tGK");
await page.click("text=Add these people");
await page.waitForSelector("[data-person='1']");
await page.waitForSelector("label.wrong .said >> text=goalkeeper"); // a role that is none is named, not dropped
seen.pasted = [await page.locator("[data-pasted]").innerText()];
await page.click("text=Paste a list");
await page.fill("[data-paste]", "pickford, Jordan Pickford, , goalkeeper");
await page.click("text=Add these people");
seen.pasted.push(await page.locator("[data-pasted]").innerText());
await page.waitForSelector('[data-saving="saved"]');
await page.waitForSelector("text=Nothing is missing");
for (const [width, height] of [[1440, 900], [1280, 720], [390, 844]]) {
  await page.setViewportSize({ width, height });
  seen[`overflow_${width}`] = await page.evaluate(() => document.documentElement.scrollWidth - innerWidth);
  await shoot(page, `ready_${width}`);
}
// Another page saves the form: this one says so, and shows that form.
const saveElsewhere = (fps) =>
  page.evaluate(async ([path, fps]) => {
    const [{ form_secret }, { revision, content }] = await Promise.all(["/api/session", path].map(async (each) => (await fetch(each)).json()));
    [content.match_id, content.cameras[1].fps] = ["cup_other", fps];
    const headers = { "content-type": "application/json", "x-form-secret": form_secret };
    await fetch(`${path}/form`, { method: "POST", headers, body: JSON.stringify({ revision, content }) });
  }, [`/api/drafts/${seen.link.split("/").at(-1)}`, fps]);
async function takeOther(fps) {
  await saveElsewhere(24);
  await page.fill('[data-field="fps"]', "26");
  await page.waitForSelector("[data-again]");
  await saveElsewhere(fps); // and once more
  await page.click("[data-again]");
  await page.waitForSelector("[data-again]", { state: "detached" });
}
await takeOther(30);
seen.again = [await page.inputValue('[data-field="match_id"]'), await page.inputValue('[data-field="fps"]')];
// On a clock of 1.2 times the rate, the moment of frame 5 is frame 6, and 4 later with an offset of 4. All videos move
// together by 6 frames of that clock with 5 of the other one, and past the first frame and back.
await page.click("[data-offsets]");
await frames.nth(0).fill("5");
await frames.nth(1).fill("10");
for (const [word, times] of [["all videos ▶", 5], ["◀ all videos", 12], ["all videos ▶", 12]])
  for (let k = 0; k < times; k++) await page.click(`dialog >> text=${word}`);
seen.together = [await frames.nth(0).inputValue(), await frames.nth(1).inputValue()];
seen.offset = await page.locator("dialog figcaption").nth(1).innerText();
await page.click("dialog >> text=Cancel");
await takeOther();
// The form is left while the server is away: it is saved when the server is back. The answer to a save broke off before.
let cut = 0;
await page.route("**/api/drafts/**", async (route) => {
  if (cut++) return route.abort();
  await route.fetch();
  return route.fulfill({ status: 200, contentType: "application/json", body: "{" });
});
await page.fill('[data-field="match_id"]', "cup_half");
await page.waitForSelector('[data-saving="not saved"]');
const again = page.waitForEvent("requestfailed", (request) => request.postData()?.includes("cup_final"));
await page.fill('[data-field="match_id"]', "cup_final");
await again;
await page.click("a.home");
const saved = page.waitForResponse((answer) => answer.url().endsWith("/form") && answer.ok());
await page.unroute("**/api/drafts/**");
await saved;
await page.goto(seen.link);
await page.waitForSelector("text=Nothing is missing");
// What changes while it is being finished is not saved: nothing is left to save it to.
await page.route("**/finish", async (route) => {
  const response = await route.fetch();
  await page.fill('[data-field="fps"]', "27");
  await route.fulfill({ response });
});
const isUnsaved = () => page.evaluate(() => !dispatchEvent(new Event("beforeunload", { cancelable: true })));
await page.click("[data-finish]");
await page.waitForSelector("text=cup_final");
await shoot(page, "arrived");
seen.unsaved = [await isUnsaved()];
// Nor is a form whose match is discarded on another page.
await page.click("[data-create]");
await page.waitForSelector("[data-missing]");
await page.evaluate(async (path) => {
  const { form_secret } = await (await fetch("/api/session")).json();
  await fetch(`${path}/removal`, { method: "POST", headers: { "content-type": "application/json", "x-form-secret": form_secret }, body: "{}" });
}, `/api/drafts/${page.url().split("/").at(-1)}`);
await page.fill('[data-field="fps"]', "27");
await page.waitForSelector("text=finished or discarded");
seen.unsaved.push(await isUnsaved());
// The restart was meant: while the server was away, the browser said so in its console.
seen.errors = seen.errors.filter((text) => !/ERR_CONNECTION|ERR_EMPTY|ERR_FAILED|409|422|Failed to fetch/.test(text));
await tell(seen);
