// A person changes settings of the project and of a match; prints what it saw as one JSON object.

import { logIn, open, shootSizes, task, tell } from "../chromium.mjs";

const seen = { errors: [], outside: [] };
const page = await open(seen);
await logIn(page, task.base, "Ada");
await page.goto(`${task.base}/#/settings/${encodeURIComponent(task.match)}`);

const layer = (name) => page.locator(`[data-layer="${name}"]`);
async function state(name, setting, value) {
  await layer(name).getByText("Add a setting").click();
  await layer(name).locator("[aria-label=Setting]").last().fill(setting);
  await layer(name).locator(".row input").last().fill(value);
  await layer(name).getByText("Save").click();
}
const inForce = async () => (await page.locator("table").count()) === 0 ? [] : page.locator("tbody tr").allInnerTexts();

await state("project", "tracking.gate_m", "0.45");
await page.locator("tbody tr").waitFor();
seen.project = await inForce();
await state(`matches/${task.match}`, "tracking.gate_m", "0.6");
await page.getByText("match", { exact: true }).waitFor();
seen.match = await inForce();
await shootSizes(page, seen, "settings");
await tell(seen);
