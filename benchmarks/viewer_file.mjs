// Opens a viewer file in Chromium without a network, and counts its pictures; prints one JSON object.

import { open, task, tell } from "../tests/chromium.mjs";

const seen = { errors: [], outside: [], rates: {} };
const page = await open(seen, 720);
await page.setViewportSize({ width: 1280, height: 720 });
await page.context().setOffline(true);
await page.goto(`file://${task.file}`);
await page.waitForFunction(() => window.worldpose?.pictures() > 1);
seen.picture = await page.evaluate(() => performance.now());
seen.paint = await page.evaluate(() => performance.getEntriesByName("first-contentful-paint")[0].startTime);
seen.renderer = await page.evaluate(() => {
  const gl = document.createElement("canvas").getContext("webgl2");
  return gl.getParameter(gl.getExtension("WEBGL_debug_renderer_info").UNMASKED_RENDERER_WEBGL);
});
seen.people = [];
for (const frame of task.frames) seen.people.push(await page.evaluate((at) => window.worldpose.people(at), frame));

// Pictures in some seconds; `turn` turns the view before each; null = the browser's own rate.
async function count(turn) {
  return page.evaluate(async (turns) => {
    const gaps = [];
    const canvas = document.querySelector("[data-scene]");
    let before = null;
    const first = window.worldpose.pictures();
    const end = performance.now() + 5000;
    await new Promise((done) => {
      requestAnimationFrame(function step(now) {
        if (before !== null) gaps.push(now - before);
        before = now;
        if (turns) canvas.dispatchEvent(new KeyboardEvent("keydown", { key: "d", bubbles: true }));
        if (performance.now() < end) requestAnimationFrame(step);
        else done();
      });
    });
    const drawn = window.worldpose.pictures() - first;
    const total = gaps.reduce((a, b) => a + b, 0);
    const pictures = turns === null ? gaps.length : Math.min(drawn, gaps.length);
    return { rate: (1000 * pictures) / total, p95: gaps.sort((a, b) => a - b)[Math.floor(0.95 * gaps.length)] };
  }, turn);
}

seen.rates["at rest, nothing drawn"] = await count(null);
for (const detail of ["reduced", "full"]) {
  await page.selectOption("[aria-label=Detail]", detail);
  await page.waitForTimeout(800);
  seen.rates[`${detail} detail, turning`] = await count(true);
  await page.click("[data-play]");
  seen.rates[`${detail} detail, playing`] = await count(false);
  await page.click("[data-play]");
}
await tell(seen);
