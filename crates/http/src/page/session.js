// Who is logged in: the login in the header, its session, and the requests that need it.

import { $, hide, make, text } from "./common.js";
import { onReturn } from "./gateway.js";
import { t } from "./texts.js";

const CHECK_MS = 10000;
const LOGIN_MS = 60000;

let session = null;
const listeners = [];
const corner = {};

export const isLoggedIn = () => session !== null;

/// Calls it whenever somebody logs in or out, or the session ends.
export const onSession = (listener) => listeners.push(listener);

/// Sends it; throws where there is no answer. A session that the gateway does not know any more ends.
export async function post(path, body, ms, abort = new AbortController()) {
  const headers = { "Content-Type": "application/json" };
  if (session) headers["X-CSRF-Token"] = session.csrf;
  const options = { method: "POST", headers, cache: "no-store", signal: abort.signal };
  if (body !== undefined) options.body = JSON.stringify(body);
  const timer = setTimeout(() => abort.abort(), ms);
  try {
    const reply = await fetch(path, options);
    const json = reply.status === 204 ? {} : await reply.json().catch(() => ({}));
    if (reply.status === 401 && path !== "api/v1/login") await check(t("The last command was not executed."));
    return { status: reply.status, json };
  } finally {
    clearTimeout(timer);
  }
}

/// Asks the gateway whose session this is: it may have been started anew, or somebody logged in or out in another tab. `lost`: what
/// is said besides if it has ended.
export async function check(lost = "") {
  let json;
  try {
    const reply = await fetch("api/v1/session", { cache: "no-store", signal: AbortSignal.timeout(10000) });
    if (!reply.ok) return;
    json = await reply.json();
  } catch {
    // It is asked again when the gateway answers.
    return;
  }
  if (!json.user && session) say(`${t("The session has ended: log in again to command.")} ${lost}`, false);
  if (json.user && !session) say("", null);
  set(json.user ? json : null);
}

function set(next) {
  const changed = session?.csrf !== next?.csrf;
  session = next;
  if (changed) show();
}

function show() {
  document.body.classList.toggle("operating", session !== null);
  hide(corner.open, session !== null);
  hide(corner.known, session === null);
  if (session) unfold(false);
  text(corner.name, session?.user ?? "");
  for (const listener of listeners) listener();
}

function say(words, good) {
  text(corner.note, words);
  corner.note.className = `operate-result ${words && good === false ? "bad" : ""}`;
}

// ---- The login

function unfold(open) {
  hide(corner.form, !open);
  corner.open.setAttribute("aria-expanded", String(open));
  if (open) corner.user.focus();
}

function button(name, words, action) {
  const made = make("button", name, words);
  made.type = "button";
  made.addEventListener("click", action);
  return made;
}

function build(place) {
  const field = (name, type, autocomplete) => Object.assign(make("input"), { name, type, autocomplete, required: true, size: 12 });
  corner.user = field("user", "text", "username");
  corner.password = field("password", "password", "current-password");
  corner.send = Object.assign(make("button", "operate-button", t("Log in")), { type: "submit" });
  corner.form = make("form", "login-form", make("label", "", `${t("User")} `, corner.user), make("label", "", `${t("Password")} `, corner.password), corner.send);
  corner.form.id = "login-form";
  corner.form.addEventListener("submit", (event) => {
    event.preventDefault();
    logIn();
  });
  corner.form.addEventListener("keydown", ({ key }) => {
    if (key !== "Escape") return;
    unfold(false);
    corner.open.focus();
  });
  corner.open = button("login-open", t("Log in"), () => unfold(corner.form.hidden));
  corner.open.setAttribute("aria-controls", corner.form.id);
  corner.name = make("b");
  corner.out = button("login-out", t("Log out"), logOut);
  corner.known = make("span", "login-known", make("span", "unseen", `${t("Logged in as")} `), corner.name, " ", corner.out);
  corner.note = make("p", "operate-result");
  corner.note.setAttribute("role", "status");
  place.setAttribute("role", "group");
  place.setAttribute("aria-label", t("Login"));
  place.append(corner.open, corner.known);
  $("login-fold").append(corner.form, corner.note);
  unfold(false);
}

async function logIn() {
  corner.send.disabled = true;
  say(t("Logging in …"), null);
  try {
    const { status, json } = await post("api/v1/login", { user: corner.user.value, password: corner.password.value }, LOGIN_MS);
    if (status === 200) set(json);
    say(status === 200 ? "" : json.error || t("The gateway replied {status}.", { status }), false);
  } catch {
    say(t("The gateway does not respond; login failed."), false);
  }
  corner.password.value = "";
  corner.send.disabled = false;
  (session ? corner.out : corner.password).focus();
}

async function logOut() {
  say("", null);
  try {
    await post("api/v1/logout", undefined, 10000);
  } catch {
    say(t("The gateway does not respond; the session may still be open there."), false);
  }
  set(null);
  corner.open.focus();
}

build($("login"));
show();
onReturn(() => check());
document.addEventListener("visibilitychange", () => document.hidden || check());
setInterval(() => document.hidden || !session || check(), CHECK_MS);
check();
