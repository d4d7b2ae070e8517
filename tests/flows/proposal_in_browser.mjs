// A person lets the page propose a camera's markings, accepts, undoes and redoes; prints what it saw.

import { logIn, open, shoot, task, tell } from "../chromium.mjs";

const seen = { errors: [], outside: [], drawn: [] };
const page = await open(seen);
const match = encodeURIComponent(task.match);

await logIn(page, task.base, "Ada");
await page.goto(`${task.base}/#/picture/${match}/${task.camera}`);
await page.waitForSelector(".stage canvas");
seen.side = await page.locator(".proposal select").inputValue();
await page.click("button >> text=Propose without clicks");
await page.waitForSelector('[data-proposal="names"]', { timeout: 240000 });
seen.names = await page.locator('[data-proposal="names"]').textContent();
await shoot(page, "proposed");
await page.click("button >> text=Accept proposal");
const kept = async () => {
  await page.waitForSelector('[data-state="saved"]', { timeout: 60000 });
  const path = `${task.base}/api/matches/${match}/pictures/${task.camera}`;
  const { drawn } = await (await page.request.get(path)).json();
  seen.drawn.push(Object.keys(drawn).length);
};
await page.waitForSelector('[data-figure="clicks"]', { timeout: 60000 });
await kept();
await shoot(page, "accepted");
await page.click("button >> text=Undo");
await kept();
await page.click("button >> text=Redo");
await kept();
await tell(seen);
