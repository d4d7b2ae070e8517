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
const state = (name) => page.locator(`[data-now=${name}]`);
const choose = () => page.locator("[data-person]").first().click({ position: { x: 20, y: 10 } });

await logIn(page, task.base, "Ada");
if (task.later) await showEarlier();
else await correct();
await tell(seen);

// A later run has no people: the results of the earlier one are there, and the page says which run it is.
async function showEarlier() {
  await page.goto(`${task.base}/#/match/${match}`);
  seen.later = await page.locator("[data-later]").textContent();
  await page.locator('[data-scene="ready"]').waitFor();
  seen.now = await state("outdated").count(); // the split is in no run yet
  seen.links = await page.locator("a >> text=/Open the report/").count();
  await shoot(page, "later");
}

async function correct() {
  await page.goto(`${task.base}/#/match/${match}`);
  await page.locator('[data-scene="ready"]').waitFor();
  seen.before = await state("ready").count();
  await choose();

  // A dialog is open: its keys are no shortcuts.
  await page.locator("button.help").click();
  await page.keyboard.press("s");
  await page.keyboard.press("Escape");
  seen.afterHelp = await kinds();

  // The key of the shortcut and the button open the field with the focus in it.
  seen.names = [];
  for (const begin of [() => page.keyboard.press("n"), () => page.locator("[data-tracks] button >> text=Name").click()]) {
    await choose();
    await begin();
    await page.keyboard.type("smith");
    await shoot(page, "naming");
    await page.keyboard.press("Enter");
    await page.locator(".row >> text=smith").waitFor();
    seen.names.push(await kinds());
    await page.locator(".people >> text=smith").waitFor(); // in the 3D view too
    seen.named = await state("ready").count(); // a name needs no run
    await page.keyboard.press("Control+z");
    await page.locator(".row >> text=smith").waitFor({ state: "detached" });
}
seen.undone = await kinds();

// A split is undone by the button.
await page.locator("[data-scrub]").fill(String(task.middle));
await choose();
const people = await page.locator("[data-person]").count();
await page.keyboard.press("s");
await page.waitForFunction((count) => document.querySelectorAll("[data-person]").length > count, people);
await shootSizes(page, seen, "split");
await page.locator("[data-tracks] button >> text=Undo").click();
await page.waitForFunction((count) => document.querySelectorAll("[data-person]").length === count, people);
seen.unsplit = await kinds();

// After a correction all pages say that a run is needed, and why.
await choose();
await page.keyboard.press("s");
await page.waitForFunction((count) => document.querySelectorAll("[data-person]").length > count, people);
await state("outdated").waitFor();
seen.words = await state("outdated").locator(".words").innerText();
seen.button = await state("outdated").locator("button.first").innerText();
await shootSizes(page, seen, "outdated");
await page.goto(`${task.base}/#/`);
seen.home = await page.locator("li.panel .state").first().textContent();
await shoot(page, "home");
await page.goto(`${task.base}/status`);
seen.status = await page.locator("td.run .state").innerText();
}
