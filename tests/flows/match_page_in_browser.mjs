// Looks at the page of a match; prints what it saw as one JSON object.

import { logIn, open, shoot, task, tell } from "../chromium.mjs";

const seen = { errors: [], outside: [] };
const page = await open(seen, 1100);
await logIn(page, task.base, "Ada");
await page.click(`a.name[href="#/match/${encodeURIComponent(task.match)}"]`);
await page.waitForSelector("table");
seen.notes = await page.locator("p.note").allInnerTexts();
seen.rows = await page.locator("table tbody tr").allInnerTexts();
await shoot(page, "match");

// Corrections come a part at a time, from the last one back.
const listed = page.locator("section.panel ul li span:first-child");
seen.listed = [await listed.count()];
for (let k = 0; k < 2; k++) {
  await page.click("text=Show earlier ones");
  await page.waitForFunction(
    (count) => document.querySelectorAll("section.panel ul li > span:first-child").length > count,
    seen.listed.at(-1),
  );
  seen.listed.push(await listed.count());
}
seen.more = await page.locator("text=Show earlier ones").count();
await shoot(page, "corrections");
await tell(seen);
