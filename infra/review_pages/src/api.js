// Asking the server: one session, its form secret with everything that changes something.

export class Refusal extends Error {
  constructor(status, body) {
    super(body.error || body.detail || `the server answers ${status}`);
    this.status = status;
    this.body = body;
  }
}

let session = null;

export async function openSession() {
  session = await ask("GET", "/api/session");
  return session;
}

export const get = (path) => ask("GET", path);
export const post = (path, body) => ask("POST", path, body);

// What a page that asks again says of an error.
export const retrying = (error) => (error instanceof Refusal ? error.message : "The server does not answer; trying again.");

let isAway = false; // the server did not answer the last request
const returns = new Set();

// Call a function whenever the server answers again; returns how to end that.
export function onReturn(call) {
  returns.add(call);
  return () => returns.delete(call);
}

// What a browser says of a server that does not answer differs, and is not plain.
async function reach(path, what) {
  const answer = await fetch(path, what).catch(() => {
    isAway = true;
    throw new Error("The server does not answer. Try again when it does.");
  });
  if (isAway) {
    isAway = false;
    for (const call of returns) call();
  }
  return answer;
}

// Change something. Who logs in again in another tab has another form secret: it is fetched, unless it is another person's.
async function change(call, path, method, kind, body) {
  const send = () => call(path, { method, headers: { "content-type": kind, "x-form-secret": session?.form_secret ?? "" }, body });
  const [sent, answer] = [session, await send()];
  if (answer.status !== 403 || !sent) return answer;
  const now = await get("/api/session");
  if (now.who !== sent.who || now.form_secret === sent.form_secret) return answer;
  session = now;
  return send();
}

async function ask(method, path, body) {
  const answer = await (method === "GET" ? reach(path) : change(reach, path, method, "application/json", JSON.stringify(body)));
  if (answer.status === 401) {
    location.assign("/login");
    throw new Refusal(401, { error: "log in first" });
  }
  const content = await answer.json().catch(() => ({}));
  if (!answer.ok) throw new Refusal(answer.status, content);
  return content;
}

export async function getBytes(path) {
  let answer = null;
  while (!answer) answer = await reach(path).catch(() => new Promise((next) => setTimeout(next, 2000)));
  if (answer.status === 401) location.assign("/login");
  if (!answer.ok) throw new Refusal(answer.status, await answer.json().catch(() => ({})));
  return answer.arrayBuffer();
}

// Send bytes, and return what the server says of them: the caller decides what a refusal means.
export async function putBytes(path, bytes) {
  const answer = await change(fetch, path, "PUT", "application/octet-stream", bytes);
  if (answer.status === 401) location.assign("/login");
  return { status: answer.status, content: await answer.json().catch(() => ({})) };
}

// Open the page that creates a match; `given` names a match whose next version it is, or an arrival that it corrects.
export async function openDraft(given = {}) {
  location.hash = `#/create/${(await post("/api/drafts", given)).id}`;
}

export const matchPath = (match) => `/api/matches/${encodeURIComponent(match)}`;

export function picturePath(match, owner, part = "", frame = null) {
  const query = frame === null ? "" : `?frame=${frame}`;
  return `${matchPath(match)}/pictures/${encodeURIComponent(owner)}${part}${query}`;
}

// Made here: an edit that is sent again is the same edit.
export function newId(kind) {
  const bytes = crypto.getRandomValues(new Uint8Array(8));
  return `${kind}.${[...bytes].map((b) => b.toString(16).padStart(2, "0")).join("")}`;
}
