// Follows a match that was put into the inbox, from Prefect's dashboard to its release, as a person
// would; prints what was seen as one JSON object.

import { logIn, open, shoot, task, tell } from "../chromium.mjs";

const seen = { errors: [], outside: [], seconds: {}, questions: 0 };
const page = await open(seen, 900);
const began = Date.now();
const note = (what) => (seen.seconds[what] = Math.round((Date.now() - began) / 100) / 10);
const shot = async (at, name) => {
  await at.waitForLoadState("networkidle", { timeout: 5000 }).catch(() => {});
  await shoot(at, name);
};
const until = async (what, isSo) => {
  for (const end = Date.now() + 1000 * task.patience; ; ) {
    if (await isSo()) return;
    if (Date.now() > end) throw new Error(`waited for ${what} in vain`);
    await page.waitForTimeout(1000);
  }
};

// The run appears in Prefect's dashboard.
// It lacks icons of some states, which is not ours to mend; requests to other machines still count.
const prefect = await open({ errors: [], outside: seen.outside }, 900);
await prefect.goto(`${task.prefect}/runs`);
await prefect.getByPlaceholder("admin:pass").fill(task.login);
await prefect.getByRole("button", { name: "Login" }).click();
const run = prefect.getByRole("link", { name: `${task.match}, ` }).first();
await run.waitFor({ timeout: 1000 * task.patience });
note("run in the dashboard");
await shot(prefect, "runs");
await run.click();
await prefect.waitForURL(/flow-run/);
const dashboard = prefect.url();
// Its pages are alive, which costs a processor that the run can use.
const rest = () => prefect.goto("about:blank");
await rest();

// Its questions are answered on the review pages.
await logIn(page, task.pages, "Ada");
const state = async () =>
  (await page.request.get(`${task.pages}/api/matches/${encodeURIComponent(task.match)}`)).json();
const asked = (now) => now.waiting.map((each) => each.unit).join();
await until("the result", async () => {
  const now = await state();
  if (now.run?.state === "failed") throw new Error("the run failed");
  if (now.at_work?.state === "running") return false;
  if (now.run?.state === "complete") return true;
  if (!now.waiting?.length) return false;
  if (seen.questions++ === 0) {
    note("first question");
    await page.goto(`${task.pages}/#/`);
    await shot(page, "queue");
    await page.click(`a.name[href="#/match/${encodeURIComponent(task.match)}"]`);
    await page.waitForSelector(".evidence figure img, .evidence table");
    await shot(page, "question");
    await prefect.goto(dashboard);
    await prefect.waitForSelector("text=Suspended");
    await shot(prefect, "suspended");
    await rest();
  }
  await page.locator("button.first >> text=Approve").first().click();
  await until("the verdict to be kept", async () => asked(await state()) !== asked(now));
  return false;
});
note("result");
await page.goto(`${task.pages}/status`);
await page.waitForSelector(`text=${task.match}`);
await shot(page, "status");
await prefect.goto(dashboard);
await prefect.waitForSelector("text=Completed", { timeout: 1000 * task.patience });
await shot(prefect, "completed");
await prefect.getByText("Artifacts", { exact: true }).click();
await prefect.waitForSelector("text=recorded");
await shot(prefect, "artifacts");

// It is released from there, too: Deployments, release, Run, Custom run.
await prefect.goto(`${task.prefect}/deployments`);
await prefect.getByRole("row").filter({ hasText: "release" }).getByRole("link").first().click();
await prefect.waitForURL(/deployment\/[-0-9a-f]+/);
await shot(prefect, "deployment");
await prefect.getByRole("button", { name: "Run", exact: true }).click();
await prefect.getByText("Custom run").click();
// The form offers the registered matches; its list opens by keyboard.
const field = (name, kind) => prefect.locator(`xpath=//label[normalize-space()="${name}"]/following::${kind}[1]`);
await field("Match", 'button[contains(@class,"p-select-button__control")]').focus();
await prefect.keyboard.press("Space");
await prefect.getByRole("option", { name: task.match, exact: true }).click();
await field("Name", "textarea").fill(task.release.name);
await field("Licence", "textarea").fill(task.release.licence);
await shot(prefect, "custom_run");
// SQLite has one writer: when it is busy, Prefect answers 503, and its dashboard asks nothing again. A person presses once more.
for (let left = 3; ; left--) {
  const answering = prefect.waitForResponse((each) => each.url().endsWith("/create_flow_run"));
  await prefect.getByRole("button", { name: "Submit" }).click();
  const answer = await answering;
  if (answer.ok()) break;
  seen.refused = [...(seen.refused ?? []), answer.status()];
  await shot(prefect, "not_submitted");
  if (answer.status() !== 503 || left === 0) throw new Error(`Prefect answers ${answer.status()}: ${await answer.text()}`);
}
await prefect.waitForURL(/deployment\/[-0-9a-f]+\?/);
await prefect.locator('a[href*="flow-run/"]').first().click();
await prefect.waitForURL(/flow-run\//);
await prefect.waitForSelector("text=Completed", { timeout: 1000 * task.patience });
note("release");
await shot(prefect, "released");
await rest();
await page.goto(`file://${task.report}`);
await page.waitForSelector("h1");
seen.report = await page.locator("h1").first().innerText();
await shot(page, "report");
await tell(seen);
