"use strict";
const help = document.getElementById("help");
const who = document.getElementById("who");
const leave = document.getElementById("leave");
let secret = "";
fetch("/api/session").then(async (answer) => {
  if (!answer.ok) return location.assign("/login");
  const session = await answer.json();
  secret = session.form_secret;
  who.textContent = `${session.who}, ${session.role}`;
  leave.hidden = false;
}).catch(() => {});
leave.addEventListener("click", async () => {
  const headers = { "content-type": "application/json", "x-form-secret": secret };
  const answer = await fetch("/api/logout", { method: "POST", headers, body: "{}" });
  location.assign(answer.ok ? (await answer.json()).next : "/login");
});
document.getElementById("ask").addEventListener("click", () => help.showModal());
document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.altKey || event.metaKey) return;
  if (event.key === "?") help.open ? help.close() : help.showModal();
  else if (help.open) return;
  else if (event.key === "q" || event.key === "Q") location.assign("/");
  else if (event.key === "r" || event.key === "R") location.reload();
});
setInterval(async () => {
  if (help.open) return;
  const isUp = await fetch("/api/health").then((answer) => answer.ok, () => false);
  if (isUp && !help.open) location.reload();
}, 1000 * Number(document.body.dataset.refresh));
