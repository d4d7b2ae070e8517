// A person types a name, splits, undoes and opens the help on the identities page; prints what it saw as one JSON object.

import { logIn, open, shoot, shootSizes, task, tell } from "../chromium.mjs";

const seen = { errors: [], outside: [] };
const page = await open(seen);
const match = encodeURIComponent(task.match);
const path = `${task.base}/api/matches/${match}`;
const kinds = async () => {
  const { groups } = await (await page.request.get(path)).json();
  return groups.flatMap((group) => Object.entries(group.kinds)).filter(([kind]) => kind.endsWith("track") || kind.endsWith("tracks"));
};
const note = () => page.locator("[data-outdated]");

await logIn(page, task.base, "Ada");
if (task.later) await showEarlier();
else await correct();
await tell(seen);

// A later run has no people: the results of the earlier one are there, and the page says which run it is.
async function showEarlier() {
  await page.goto(`${task.base}/#/match/${match}`);
  seen.later = await page.locator("[data-later]").textContent();
  seen.links = await page.locator("a >> text=/Open the report|in 3D/").count();
  await shoot(page, "later");
  await page.goto(`${task.base}/#/results/${match}/clip`);
  await page.locator('[data-scene="ready"]').waitFor();
  seen.laterIn3d = await page.locator("[data-later]").textContent();
  await shoot(page, "later_3d");
}

async function correct() {
  await page.goto(`${task.base}/#/match/${match}`);
  await page.waitForSelector("[data-corrections]");
  seen.before = await note().count();
  await page.goto(`${task.base}/#/identities/${match}/clip`);
  await page.locator("[data-person]").first().click();

  // A dialog is open: its keys are no shortcuts.
  await page.locator("button.help").click();
  await page.keyboard.press("s");
  await page.keyboard.press("Escape");
  seen.afterHelp = await kinds();

  // The key of the shortcut and the button open the field with the focus in it.
  seen.names = [];
  for (const begin of [() => page.keyboard.press("n"), () => page.locator("button >> text=Name").click()]) {
    await page.locator("[data-person]").first().click();
    await begin();
    await page.keyboard.type("smith");
    await shoot(page, "naming");
    await page.keyboard.press("Enter");
    await page.locator(".row >> text=smith").waitFor();
    seen.names.push(await kinds());
    await page.keyboard.press("Control+z");
    await page.locator(".row >> text=smith").waitFor({ state: "detached" });
}
seen.undone = await kinds();

// A split is undone by the button.
await page.locator("[data-person]").first().click();
await page.locator("input[type=range]").fill(String(task.middle));
const people = await page.locator("[data-person]").count();
await page.keyboard.press("s");
await page.waitForFunction((count) => document.querySelectorAll("[data-person]").length > count, people);
await shootSizes(page, seen, "split");
await page.locator("button >> text=Undo").click();
await page.waitForFunction((count) => document.querySelectorAll("[data-person]").length === count, people);
seen.unsplit = await kinds();

// After a correction both pages say what is to be computed.
await page.locator("[data-person]").first().click();
await page.keyboard.press("n");
await page.keyboard.type("kane");
await page.keyboard.press("Enter");
await page.locator(".row >> text=kane").waitFor();
await page.goto(`${task.base}/#/match/${match}`);
await note().waitFor();
seen.note = await note().locator("span").textContent();
seen.button = await note().locator("button").textContent();
await shootSizes(page, seen, "outdated");
seen.units = (await (await page.request.get(path)).json()).units;
await page.goto(`${task.base}/#/`);
seen.home = await page.locator("li.panel .state").first().textContent();
await shoot(page, "home");
}
