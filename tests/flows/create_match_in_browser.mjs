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
async function takeOther(fps) {
  await page.evaluate(async ([path, fps]) => {
    const [{ form_secret }, { revision, content }] = await Promise.all(["/api/session", path].map(async (each) => (await fetch(each)).json()));
    [content.match_id, content.cameras[1].fps] = ["cup_other", fps];
    const headers = { "content-type": "application/json", "x-form-secret": form_secret };
    await fetch(`${path}/form`, { method: "POST", headers, body: JSON.stringify({ revision, content }) });
  }, [`/api/drafts/${seen.link.split("/").at(-1)}`, fps]);
  await page.fill('[data-field="fps"]', "26");
  await page.click("[data-again]");
}
await takeOther(50);
seen.again = [await page.inputValue('[data-field="match_id"]'), await page.inputValue('[data-field="fps"]')];
// On a clock of twice the rate, the moment of frame 5 is frame 10, and 6 later with an offset of 6.
await page.click("[data-offsets]");
await frames.nth(0).fill("5");
await frames.nth(1).fill("16");
seen.offset = await page.locator("dialog figcaption").nth(1).innerText();
await page.click("dialog >> text=Cancel");
await takeOther();
// The form is left while the server is away: it is saved when the server is back.
await page.route("**/api/drafts/**", (route) => route.abort());
await page.fill('[data-field="match_id"]', "cup_final");
await page.waitForSelector('[data-saving="not saved"]');
await page.click("a.home");
const saved = page.waitForResponse((answer) => answer.url().endsWith("/form") && answer.ok());
await page.unroute("**/api/drafts/**");
await saved;
await page.goto(seen.link);
await page.waitForSelector("text=Nothing is missing");
await page.click("[data-finish]");
await page.waitForSelector("text=cup_final");
await shoot(page, "arrived");
// The restart was meant: while the server was away, the browser said so in its console.
seen.errors = seen.errors.filter((text) => !/ERR_CONNECTION|ERR_EMPTY|ERR_FAILED|409|Failed to fetch/.test(text));
await tell(seen);
