// A person corrects one refused arrival and removes another, applies the clock offsets that the page proposes, and adds
// the video of a further camera to a match. Prints what it saw as one JSON object.

import { writeFileSync } from "node:fs";
import { logIn, open, shootSizes, task, tell } from "../chromium.mjs";

const seen = { errors: [], outside: [] };
const page = await open(seen, 900);
page.on("dialog", (dialog) => dialog.accept());
await logIn(page, task.base, "Ada");

await page.waitForFunction(() => document.querySelectorAll("[data-arrivals] .wrong").length === 2);
seen.reason = await page.locator("[data-arrivals] li", { hasText: "cup" }).innerText();
await shootSizes(page, seen, "refused");
await page.locator("[data-arrivals] li", { hasText: "old" }).getByText("Remove").click();
await page.waitForSelector("text=The files are in");
await page.locator("[data-arrivals] li", { hasText: "cup" }).getByText("Correct it").click();
await page.waitForSelector("[data-missing]");
await page.fill('[data-field="fps"]', "25");
await page.waitForSelector("text=Nothing is missing");
await page.click("[data-finish]:enabled");
await page.waitForSelector("li.panel >> text=cup");
await page.waitForSelector("[data-arrivals]", { state: "detached" });

// A registered match whose folder was damaged.
writeFileSync(task.damaged, "{");
await page.goto(`${task.base}/#/match/cup`);
await page.waitForSelector("text=Correct its files");
await shootSizes(page, seen, "damaged");
await page.click("text=Correct its files");
await page.waitForSelector("text=Nothing is missing");
seen.corrected = await page.inputValue('[data-field="fps"]');
await page.click("[data-finish]:enabled");
await page.waitForSelector("[data-next]");
await shootSizes(page, seen, "next");
await page.waitForSelector("[data-next]", { state: "detached" });
await page.waitForSelector("text=cannot be opened", { state: "detached" });

const match = `${task.base}/#/match/${task.match}`;
await page.goto(match);
await page.click("[data-clocks] summary");
await page.waitForSelector("[data-apply]");
seen.apply = await page.locator("[data-apply]").innerText();
await page.waitForFunction(() => document.querySelector("[data-clocks] img").naturalWidth > 0);
await page.locator("[data-clocks]").scrollIntoViewIfNeeded();
await shootSizes(page, seen, "clocks");
await page.click("[data-apply]");
await page.waitForSelector("[data-clocks] >> text=Applied");
await page.waitForSelector("[data-next]");
await page.waitForSelector("[data-next]", { state: "detached" });

await page.click("[data-add]");
await page.waitForSelector("text=nothing has changed yet");
seen.title = await page.locator("h1").innerText();
await page.setInputFiles("[data-upload]", task.video);
await page.waitForSelector('li[data-file="roof.mp4"][data-state="ready"]');
await page.click("text=Add a camera for the video");
await page.waitForSelector("[data-foreseen]");
seen.foreseen = await page.locator("[data-foreseen]").innerText();
await shootSizes(page, seen, "adding");
await page.click("[data-finish]:enabled");
await page.waitForSelector("[data-next]");
await page.waitForSelector("[data-next]", { state: "detached" });
await page.waitForSelector("[data-now=calibrate] >> text=roof");
await shootSizes(page, seen, "added");
await tell(seen);
