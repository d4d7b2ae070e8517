// The pages at a server whose answers are stubs: slow, refusing, or of another run; prints what it saw as one JSON object.

import { readFileSync } from "node:fs";
import { open, task, tell } from "../chromium.mjs";

const seen = { errors: [], outside: [] };
const KINDS = { html: "text/html", js: "text/javascript", css: "text/css" };
const at = "2026-01-01T00:00:00Z";
const wait = (seconds) => new Promise((done) => setTimeout(done, 1000 * seconds));
let page = null;

// A page with `answer` as its server: content, or [status, content].
async function at_server(place, answer) {
  await page?.close();
  page = await open({ errors: [], outside: [] }); // refusals are errors on the console
  page.setDefaultTimeout(10000);
  page.on("pageerror", (error) => seen.errors.push(error.message));
  await page.route("**/*", async (route) => {
    const { pathname, search } = new URL(route.request().url());
    if (!pathname.startsWith("/api/")) {
      const file = pathname === "/" ? "/index.html" : pathname;
      return route.fulfill({ body: readFileSync(task.static + file), contentType: KINDS[file.split(".").pop()] });
    }
    const given = (await answer(pathname, search, route.request().postDataJSON(), route.request().headers())) ?? (pathname.includes("/views/") ? { people: [] } : pathname.includes("/detections/") ? [404, {}] : {});
    const [status, content] = Array.isArray(given) && typeof given[0] === "number" ? given : [200, given];
    return route.fulfill({ status, contentType: "application/json", body: JSON.stringify(content) }).catch(() => {});
  });
  await page.goto(`http://127.0.0.1:9/#/${place}`);
}

const session = { who: "Ada", role: "approver", form_secret: "one", project: "p", takes_files: true };
const question = (k) => ({
  id: `q${k}`, unit: `bundle_adjustment/part${k}`, excess: 9 - k, state: "waits", question: "Good?", said: [], consequences: {}, figures: {},
  reasons: [], created_at: at, decision: null, gate: "bundle_adjustment",
});
const matchOf = (run, reviews) => ({
  match: "final", is_unseen: false, problem: null, damage: [], has_image: true, corrections: 0, first_clicks: 0, stale: 0, at_work: null,
  run: { id: run, state: "complete", finished_at: at, gates: "auto", usability: { verdict: "good", reservations: [] }, failed: 0 },
  waiting: reviews.filter((each) => each.state === "waits").map(({ id, unit }) => ({ id, unit, rejected: false })), reviews, to_click: [], groups: [],
  state: { name: "ready", words: "ready", why: "", todo: "", seconds: null, units: {} },
  cameras: ["north", "south"].map((id) => ({ id, given: true, clicks: 0, has_picture: false, figures: {} })),
  clips: [{ id: "half", fps: 25, first_frame: 100, frame_count: 200, cameras: ["north"], has_video: false, key_frames: [], pick_next: [], has_tracks: true }],
  failures: [], stages: [], next_versions: [], left_out: {}, warnings: [],
});
const resultsOf = (run) => ({
  run, state: "complete", later: "", formats: ["csv", "usd", "c3d"], purposes: { csv: "", usd: "", c3d: "" },
  impossible: { minimap: "The match has no pitch." },
  clips: [{ id: "half", video: null, without_joints: null }],
});
const trackOf = (id, name) => ({ id, name, seen: { north: 1 }, segments: [[100, 299]], views: 2, way: Array(200).fill([0.4 * (id - 7), 0]) });

// A new run while the page is open; two names at once; two downloads at once.
async function showNewRun() {
  let [run, slow, broken] = ["0001", 0, []];
  const [asked, names, sent, written, crops, merged] = [[], {}, [], [], [], []];
  await at_server("match/final", async (path, search, body) => {
    if (path.includes("/scenes/")) asked.push(search);
    if (path.includes("/scenes/")) return [500, { error: "stub" }];
    if (path.includes("/exports/")) written.push(`${path.split("/").at(-1)}${search}`);
    if (path.includes("/exports/")) await wait(0.5);
    if (broken.some((form) => path.endsWith(form))) return [422, { error: "no disk ".repeat(60) }];
    if (path === "/api/session") return session;
    if (path === "/api/matches/final") return matchOf(run, []);
    if (path.endsWith("/results")) return resultsOf(run);
    if (path.endsWith("/metrics")) return { metrics: [{ kind: "camera", name: "north", values: { "x clicks_wrong": Number(run) } }], names: {}, before: null, problem: "", changes: [], unchanged: 0 };
    if (path.endsWith("/offsets")) return body ? {} : { clip: "half", cameras: [], changed: { south: Number(run) }, verdict: `told of ${run}`, warning: "" };
    if (path.endsWith("/runs")) return [];
    if (path === "/api/inbox") return { inbox: null, arrivals: [] };
    if (path.endsWith("/corrections")) {
      const { edit } = body.edits[0];
      if (edit.kind === "merged_tracks") merged.push(edit.kept, edit.merged);
      else sent.push(edit.name);
      names[edit.person] = edit.name;
    }
    if (path.endsWith("/crop")) crops.push(new URLSearchParams(search).get("run_id"));
    if (!path.includes("/identities/") || path.endsWith("/crop")) return null;
    await wait(slow);
    return { clip: "half", fps: 25, first_frame: 100, frame_count: 200, step: 1, pitch: null, roster: [], events: [], has_video: true, joins: [{ before: 8, after: 7, last_frame: 150, first_frame: 160 }], people: [7, 8].map((id) => trackOf(id, names[id] ?? null)) };
  });
  await page.click("summary >> text=Metrics per camera");
  await page.click("summary >> text=Clocks of the cameras");
  await page.click("[data-apply]");
  const look = async () => [
    (await page.locator('[data-metrics="camera"] tbody').innerText()).trim(), await page.locator("[data-clocks] img").getAttribute("src"),
    await page.locator("[data-clocks] [role=status]").count(), await page.locator("[data-verdict]").innerText(),
  ];
  await page.waitForSelector("[data-clocks] [role=status]");
  seen.before = await look();
  run = "0002";
  await page.waitForSelector("[data-apply]").catch(() => {});
  await wait(1);
  seen.after = await look();
  seen.scenes = [...new Set(asked)];
  for (const form of ["usd", "c3d"]) await page.click(`[data-downloads] a >> text=${form}`);
  await wait(3);
  seen.written = [...new Set(written)];
  // What cannot be written is no link and says why; of two refusals the last one is seen, and no page but theirs shows it.
  await page.click("[data-impossible] summary");
  seen.impossible = [await page.locator("[data-impossible]").innerText(), await page.locator("[data-impossible] a").count()];
  broken = ["usd", "c3d"];
  for (const form of broken) await page.click(`[data-downloads] a >> text=${form}`);
  await page.locator("[role=alert] >> text=c3d: no disk").waitFor();
  seen.alerts = [await page.locator(".messages [role=alert]").count()];
  await page.setViewportSize({ width: 390, height: 800 });
  seen.covered = (await page.locator(".messages").boundingBox()).height;
  await page.setViewportSize({ width: 1440, height: 900 });
  await page.evaluate(() => (location.hash = "#/"));
  await page.waitForSelector("[data-downloads]", { state: "detached" });
  seen.alerts.push(await page.locator("[role=alert] >> text=no disk").count());
  await page.goBack();
  await page.waitForSelector("[data-person]");
  slow = 1;
  for (const [id, name] of [[7, "kane"], [8, "rice"]]) {
    await page.dblclick(`[data-person="${id}"]`);
    await page.fill('input[aria-label="Name"]', name);
    await page.keyboard.press("Enter");
  }
  await page.dblclick('[data-person="7"]'); // its name waits, and is neither lost nor sent again
  seen.begun = await page.inputValue('input[aria-label="Name"]');
  await page.keyboard.press("Enter");
  await wait(4);
  seen.names = sent;
  seen.crops = [...new Set(crops)];
  // Keys move by a frame, a second, or to an end; people on a map of 40 cm are neither large nor cut off.
  await page.click('[data-person="7"]');
  seen.moves = [];
  for (const key of ["Home", "ArrowRight", "Shift+ArrowRight", "ArrowLeft", "End"]) {
    await page.keyboard.press(key);
    await wait(0.2);
    seen.moves.push((await page.locator("[data-tracks] .top .soft").first().innerText()).match(/frame (\d+)/)[1]);
  }
  const shapes = (kind) => page.locator(`[data-tracks] svg ${kind}`).evaluateAll((all) => all.map((each) => each.getBoundingClientRect().toJSON()));
  const [map] = await page.locator("[data-tracks] svg").evaluateAll((all) => all.map((each) => each.getBoundingClientRect().toJSON()));
  seen.discs = (await shapes("circle")).map((each) => Math.round(each.width));
  seen.cut = (await shapes("text")).filter((each) => each.left < map.left || each.right > map.right || each.top < map.top).length;
  // Nobody is seen before the first frame; two people are joined without Shift, and not those of a question in between.
  await page.click('[data-person="7"] .bar', { position: { x: 1, y: 4 } });
  seen.split = [await page.locator("[data-split]").innerText(), await page.locator("[data-tracks] button >> text=Split").isDisabled()];
  await page.click("button >> text=Join two");
  await page.click(".join .plain");
  await page.click('[data-person="7"]');
  await page.click("button >> text=Join two", { timeout: 5000 });
  await page.click('[data-person="8"]');
  await page.click("button >> text=Join these two");
  await wait(2);
  seen.pair = merged;
}

const held = async (key, count) => {
  for (let k = 0; k < count; k++) {
    await page.keyboard.down(key);
    await wait(0.15);
  }
  await page.keyboard.up(key);
};

// A question whose evidence comes at the second request, with a long curve, and whose video cannot be drawn; held keys.
async function ask() {
  await at_server("match/final", (path) => ({ "/api/session": session, "/api/matches/final": matchOf("0001", [question(1)]), "/api/matches/final/results": { ...resultsOf("0001"), clips: [] } })[path] ?? (path.endsWith("/evidence") ? { pictures: [], curves: [], tables: [] } : undefined));
  await page.waitForSelector("article.open");
  await wait(0.5);
  seen.scrolled = [await page.evaluate(() => [scrollY, document.querySelector("main").scrollTop])];
  let reviews = [1, 2, 3, 4].map(question);
  let isThere = false;
  const [decided, removed] = [[], []];
  await at_server("match/final?review=q1", (path, search, body) => {
    if (path === "/api/session") return session;
    if (path === "/api/matches/final") return matchOf("0001", reviews);
    if (path.endsWith("/results")) return { ...resultsOf("0001"), clips: [] };
    if (path.endsWith("/runs")) return [];
    if (path.endsWith("/video")) return [422, { error: "the video is damaged" }];
    if (path.endsWith("/outliers")) return [1, 2, 3, 4, 5].map((k) => ({ surprise: 9, of: "click", out: removed.includes(k), edit: { kind: "moved_point", camera: "north", frame: k, marking: `point${k}`, xy: null } }));
    if (path.endsWith("/evidence") && !isThere) return [500, { error: "no memory" }];
    if (path.endsWith("/evidence")) {
      const curves = [{ title: "error", values: Array(135000).fill(0.5) }];
      return { pictures: [], tables: [{ title: "Joins", columns: ["a"], rows: [["one"]] }], curves, first_frame: 0, last_frame: 200000, frames_per_value: 2, video: "north", clicked: [] };
    }
    if (path.endsWith("/corrections")) removed.push(body.edits[0].edit.frame);
    if (path.endsWith("/decisions")) {
      decided.push(...body.reviews);
      reviews = reviews.map((each) => (body.reviews.includes(each.id) ? { ...each, state: "approve", decision: { verdict: "approve", who: "Ada", why: "", decided_at: at } } : each));
    }
    return null;
  });
  const evidence = page.locator("article.open .evidence");
  await evidence.locator(".note >> text=no memory").waitFor();
  isThere = true;
  await evidence.locator("button >> text=Try again").click();
  await evidence.locator("[data-outlier]").first().waitFor();
  seen.curves = await evidence.locator("polyline").count();
  const box = await evidence.locator("[data-curve] svg").boundingBox();
  await page.mouse.move(box.x + box.width - 1, box.y + 5);
  seen.near = await evidence.locator("h3 .soft").innerText();
  await page.click("article.open .question");
  await page.keyboard.press("v");
  await evidence.locator(".note >> text=the video is damaged").waitFor();
  seen.tables = await evidence.locator("h3 >> text=Joins").count();
  await held("x", 5);
  await held("ArrowDown", 3);
  seen.row = await evidence.locator("tr.chosen").getAttribute("data-outlier");
  await held("a", 5);
  await wait(0.5);
  Object.assign(seen, { removed, decided });
}

// Clicks: one behind the camera, and one after the same, then another person has logged in elsewhere.
async function click() {
  const [kept, refined] = [[], []];
  let now = session;
  const pitch = { length: 105, width: 68, points: { near: [-52.5, -34, 0], far: [-52.5, 34, 0] }, markings: {} };
  const camera = { camera: { center: [0, -40, 8], focal: 1400 }, markings: {}, points: {}, drawn: [], wrong: ["far"], reasons: [], add_next: [], median: 0.1, p95: 0.2, limit: 0.15 };
  const residuals = [{ name: "far", residual: null, surprise: null, inlier: false }, { name: "near", residual: [1, 1], surprise: 1, inlier: true }];
  await at_server("picture/final/north", (path, search, body, headers) => {
    if (path === "/api/session") return now;
    if (body && headers["x-form-secret"] !== now.form_secret) return [403, { error: "the page is of another session: load it again" }];
    if (path.endsWith("/preview")) return { ...camera, residuals };
    if (path.endsWith("/corrections")) kept.push(body.edits.length);
    if (path.endsWith("/north")) return { match: "final", owner: "north", frame: null, given: false, side: null, has_picture: false, size: [1920, 1080], pitch, points: { near: [200, 300], far: [900, 300] }, drawn: {}, figures: {}, reviews: [], cameras: ["north"], key_frames: [] };
    return null;
  });
  await page.locator(".figures dl").waitFor();
  seen.drawn = await page.locator(".figures .note.bad").count();
  const state = async () => {
    await page.keyboard.press("ArrowRight"); // moves the click
    await wait(2);
    return page.locator("[data-state]").getAttribute("data-state");
  };
  await page.locator("tbody tr").first().click();
  now = { ...session, form_secret: "two" };
  seen.same = await state();
  now = { ...session, who: "Bob", form_secret: "three" };
  seen.other = await state();
  seen.kept = kept.length;
}

// An image that the server refuses, and a camera that is given.
async function refuse() {
  await at_server("picture/final/north", (path) => (path === "/api/session" ? session : { given: true, pose: ["It stands."], pitch: {}, has_picture: false, size: [1920, 1080], markings: { line: [[[0, 0], [900, 900]]] } }));
  seen.given = await page.waitForSelector("[data-given] canvas").then(() => true, () => false);
  // Without a pitch the people tell whether the camera is right.
  await at_server("picture/final/north", (path) => {
    if (path === "/api/session") return session;
    if (path.endsWith("/results")) return resultsOf("0001");
    if (path.endsWith("/views/north")) return { people: [{ person: 7, name: "", keypoints: [[30, 30], [40, 60]] }] };
    if (path.endsWith("/detections/north")) return { frame: 100, frames: [[100, 299]], size: [100, 100], has_picture: false, joints: ["nose", "left_eye"], bones: [[0, 1]], free: 0, note: "", people: [], cameras: ["north"] };
    return { given: true, pose: ["It stands."], pitch: null, clip: "half", has_picture: false, size: [100, 100], markings: {} };
  });
  await page.locator("[data-placed] line").first().waitFor({ state: "attached", timeout: 4000 }).catch(() => {});
  seen.lab = [await page.locator("[data-placed] line").count(), await page.locator("main >> text=It stands.").count(), await page.locator("main button >> text=Add files").count()];
  await at_server("picture/final/north", (path) => {
    if (path === "/api/session") return session;
    return path.endsWith("/image") ? [422, { error: "north.png: expected a PNG image, found damaged bytes" }] : { pitch: {}, has_picture: true };
  });
  seen.refused = await page.locator("main [role=alert]").innerText();
}

// Arrow keys in a camera whose clips are not in rising order; the other cameras cannot be asked.
async function step() {
  let [run, saving, early] = ["0001", 0, 0];
  await at_server("match/final", async (path, search) => {
    if (path === "/api/session") return session;
    if (path === "/api/matches/final") return matchOf(run, []);
    if (path.endsWith("/results")) return { ...resultsOf(run), clips: [] };
    if (path.endsWith("/corrections")) {
      saving = 1;
      await wait(5);
      saving = 0;
    }
    if (path.endsWith("/runs")) return [];
    if (path.endsWith("/queue")) return { left: 0, people: 1, next: [] };
    if (path.endsWith("/views")) return [422, { error: "no calibration of south" }];
    if (!path.endsWith("/detections/north")) return [404, {}];
    early += saving;
    const frame = Number(new URLSearchParams(search).get("frame") ?? 150);
    const people = [{ detection: 0, called: "kane", box: [10, 10, 50, 90], score: 1, keypoints: [[30, 30]], confidence: [1] }];
    return { frame, frames: [[200, 299], [100, 199]], size: [100, 100], has_picture: false, joints: ["nose"], bones: [], free: 1, note: "", cameras: ["north"], people };
  });
  await page.click("[data-edit]");
  await page.locator("aside h2").click();
  await page.keyboard.press("ArrowRight");
  await page.locator("aside h2 >> text=frame 151").waitFor({ timeout: 3000 }).catch(() => {});
  seen.frame = await page.locator("aside h2").innerText();
  await page.locator("aside > table tbody tr").click();
  await page.locator("aside [role=alert]").waitFor({ timeout: 3000 }).catch(() => {});
  seen.views = await page.locator("aside [role=alert]").allInnerTexts();
  seen.called = [await page.locator("[data-called]").innerText(), await page.locator("aside > table tbody td").first().innerText()];
  // On a phone the picture stays in view while the tools are scrolled.
  await page.setViewportSize({ width: 390, height: 800 });
  await page.locator("aside > table").scrollIntoViewIfNeeded();
  await page.locator("aside > table").evaluate((table) => table.scrollIntoView({ block: "end" }));
  await wait(0.5);
  seen.phone = await page.evaluate(() => ["[data-player] .picture", "aside > table"].map((part) => document.querySelector(part).getBoundingClientRect()).map(({ top, bottom }) => top >= 0 && bottom <= innerHeight + 1));
  await page.setViewportSize({ width: 1366, height: 768 });
  await page.keyboard.press("x");
  run = "0002"; // its people are shown when the correction is saved, and none is chosen
  await wait(7);
  seen.renewed = [early, await page.locator("aside > table tbody tr").count(), await page.locator("tr.chosen").count()];
}

await showNewRun();
await ask();
await click();
await refuse();
await step();
await tell(seen);
