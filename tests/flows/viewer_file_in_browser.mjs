// Opens a viewer file from disk, plays and looks; prints what it saw as one JSON object.

import { Labels } from "../../infra/review_pages/src/viewer/labels.js";
import { open, shoot, task, tell } from "../chromium.mjs";

const seen = { errors: [], outside: [] };
const page = await open(seen, 900);
await page.context().setOffline(true);
await page.goto(`file://${task.file}`);
await page.waitForSelector('[data-scene="ready"]');
const canvas = page.locator("[data-scene]");
await page.waitForFunction(() => window.worldpose?.pictures() > 0);
await page.waitForTimeout(500);
seen.first_paint_ms = await page.evaluate(() => performance.getEntriesByName("first-contentful-paint")[0]?.startTime);
seen.title = await page.title();
seen.people = await page.evaluate(async (frames) => {
  const found = [];
  for (const frame of frames) found.push(await window.worldpose.people(frame));
  return found;
}, task.frames);
await canvas.screenshot({ path: task.picture });
for (const [width, height] of [[1440, 900], [1280, 720], [390, 844]]) {
  await page.setViewportSize({ width, height });
  await page.waitForTimeout(500);
  seen[`overflow_${width}`] = await page.evaluate(() => document.documentElement.scrollWidth - innerWidth);
  await shoot(page, `file_${width}`);
}
// Fingers: one turns, so that the picture changes; the page itself stays where it is.
const box = await canvas.boundingBox();
const fingers = await page.context().newCDPSession(page);
const touch = (type, x, y) => fingers.send("Input.dispatchTouchEvent", { type, touchPoints: type === "touchEnd" ? [] : [{ x, y }] });
const before = await page.evaluate(() => window.worldpose.pictures());
await touch("touchStart", box.x + 200, box.y + 150);
for (let k = 1; k < 8; k++) await touch("touchMove", box.x + 200 - 12 * k, box.y + 150);
await touch("touchEnd");
await page.waitForFunction((count) => window.worldpose.pictures() > count, before);
await shoot(page, "file_turned");
await page.setViewportSize({ width: 1280, height: 720 });
await canvas.focus();
const frame = async () => Number(await canvas.getAttribute("data-frame"));
const first = await frame();
await page.keyboard.press("End");
seen.last = (await frame()) - first;
await page.keyboard.press("Home");
await page.keyboard.press("ArrowRight");
seen.stepped = (await frame()) - first;
await page.keyboard.press("v");
if ((await page.locator("[aria-label=Colours]").inputValue()) === "team") await page.keyboard.press("v");
seen.colours = await page.locator("[aria-label=Colours]").inputValue();
await page.keyboard.press("n");
await page.keyboard.press("s");
await page.waitForTimeout(600);
await canvas.screenshot({ path: task.coloured });
await shoot(page, "file_uncertainty");
await page.keyboard.press("c");
await page.waitForTimeout(500);
await shoot(page, "file_through");
seen.through = await page.locator("[aria-label=Camera]").inputValue();
await page.keyboard.press("0");
if (task.video) {
  await page.click("[data-watch]");
  await page.waitForFunction(() => document.querySelector("video")?.readyState >= 2);
  await page.locator("[data-scrub]").fill("20");
  await page.waitForTimeout(500);
  seen.video = await page.evaluate(() => document.querySelector("video").currentTime);
  await shoot(page, "file_video");
}
await canvas.focus();
await page.keyboard.press("Home");
await page.keyboard.press("Space");
await page.waitForFunction((from) => Number(document.querySelector("[data-scene]").dataset.frame) > from + 20, first);
seen.played = (await frame()) - first;
await page.keyboard.press("Space");
// Of names at one place in the picture the nearest is written: here the depth is z.
const M = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0];
const names = [[0, 0, 4], [0, 0, 2], [1.8, 0, 2]].map((place, k) => [place, "name", [k, 0, 0]]);
const rows = Labels.prototype.apart.call({ boxes: new Map([["name", [0, 0, 60, 18]]]) }, names, M, 800, 600);
seen.labels = [rows.length, rows[7], rows[17]];
await tell(seen);
