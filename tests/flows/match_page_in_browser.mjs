// Looks at the page of a match; prints what it saw as one JSON object.

import { logIn, open, shoot, task, tell } from "../chromium.mjs";

const seen = { errors: [], outside: [] };
const page = await open(seen, 1100);
await logIn(page, task.base, "Ada");
await page.click(`a.name[href="#/match/${encodeURIComponent(task.match)}"]`);
await page.waitForSelector("table");
seen.notes = await page.locator("p.note, [data-usability]").allInnerTexts();
seen.rows = await page.locator("table tbody tr").allInnerTexts();
await shoot(page, "match");

// Corrections come in groups; those of a group a part at a time, from the last one back.
await page.click("[data-group] button[aria-expanded]");
await page.waitForSelector("[data-group] ol li");
const listed = page.locator("[data-group] ol li");
seen.listed = [await listed.count()];
for (let k = 0; k < 2; k++) {
  await page.click("text=Show earlier ones");
  await page.waitForFunction((count) => document.querySelectorAll("[data-group] ol li").length > count, seen.listed.at(-1));
  seen.listed.push(await listed.count());
}
seen.more = await page.locator("text=Show earlier ones").count();
await shoot(page, "corrections");

// A whole group is undone after a second click; what is refused stays until it is dismissed.
await page.route("**/withdrawal", (route) => route.fulfill({ status: 422, json: { error: "refused for a test" } }));
await page.click("text=Undo all 450");
await page.click("text=Yes");
await page.waitForSelector("text=refused for a test");
await page.waitForTimeout(7000); // the page asks for news every three seconds
seen.stays = await page.locator("[role=alert] >> text=refused for a test").count();
await page.click("text=Dismiss");
seen.dismissed = await page.locator("text=refused for a test").count();
await page.unroute("**/withdrawal");
await page.click("text=Undo all 450");
await page.click("text=Yes");
await page.waitForFunction(() => !document.querySelector("[data-group]"));
for (const [width, height] of [[1440, 900], [1280, 720], [390, 844]]) {
  await page.setViewportSize({ width, height });
  seen[`overflow_${width}`] = await page.evaluate(() => document.documentElement.scrollWidth - innerWidth);
  await shoot(page, `undone_${width}`);
}

// A run at work says how far it is, and a viewer is told who decides.
const change = (path, how) =>
  page.route(path, async (route) => {
    const answer = await route.fetch();
    await route.fulfill({ response: answer, json: { ...(await answer.json()), ...how } });
  });
await change(`**/api/matches/${encodeURIComponent(task.match)}`, { at_work: { state: "running", percent: 41.6, stage: "tracking", lines: ["tracking, 18 s left"] } });
await page.setViewportSize({ width: 1280, height: 720 });
await page.waitForSelector("[data-now=running] progress");
seen.progress = (await page.locator("[data-now=running] .words").innerText()).replace(/\s+/g, " ").trim();
seen.cancel = await page.locator("[data-now=running] button >> text=Cancel").count();
await page.click("text=Steps");
seen.steps = await page.locator("[data-now=running] li.at").innerText();
await shoot(page, "at_work");
await page.unrouteAll({ behavior: "wait" });
await change("**/api/session", { role: "viewer" });
await page.reload();
await page.waitForSelector("text=An approver starts runs");
seen.who = await page.locator(".who").innerText();
seen.run_buttons = await page.locator("button:has-text('run'), button:has-text('Run')").count();
await shoot(page, "viewer");
seen.errors = seen.errors.filter((text) => !text.includes("422"));
await tell(seen);
