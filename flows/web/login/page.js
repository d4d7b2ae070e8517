"use strict";
const form = document.getElementById("login");
const message = document.getElementById("message");
const field = (name) => document.getElementById(name);

// Where the person came from, on this server alone: a link can name any address.
const asked = new URLSearchParams(location.search).get("next") || "";
const next = `/${asked.replace(/^[/\\\s]+/, "")}`;

// The token is in the URL fragment, which browsers do not send.
const given = new URLSearchParams(location.hash.slice(1)).get("token");
if (given) {
  field("token").value = given;
  history.replaceState(null, "", "/login");
}
field("who").value = localStorage.getItem("who") || "";
(field("who").value ? field("token") : field("who")).focus();

// Of a person who has logged in, #out asks whether to log out; a link alone must not do it.
fetch("/api/session").then(async (answer) => {
  const { form_secret: secret } = await answer.json();
  if (secret && location.hash === "#out" && confirm("Log out?")) {
    const headers = { "content-type": "application/json", "x-form-secret": secret };
    const left = await fetch("/api/logout", { method: "POST", headers, body: "{}" });
    location.replace((await left.json()).next);
  } else if (answer.ok) location.replace(next);
});

form.addEventListener("submit", async (event) => {
  event.preventDefault();
  message.textContent = "";
  const who = field("who").value.trim();
  try {
    const send = () => fetch("/api/login", {
      method: "POST",
      headers: { "content-type": "application/json" },
      body: JSON.stringify({ who, token: field("token").value.trim() }),
    });
    let answer = await send();
    for (let tries = 0; answer.status === 429 && tries < 20; tries += 1) {
      message.textContent = "Too many wrong tokens were sent: trying again.";
      await new Promise((resolve) => setTimeout(resolve, 300 + 700 * Math.random()));
      answer = await send();
    }
    if (answer.ok) {
      localStorage.setItem("who", who);
      location.replace(next);
    } else {
      message.textContent = (await answer.json()).error || "That did not work.";
    }
  } catch {
    message.textContent = "The server does not answer. Try again, or ask its operator.";
  }
});
