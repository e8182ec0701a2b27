// Stop all: a button in the header, asked back once, and what became of each drive.

import { $, className, clock, hide, make, text } from "./common.js";
import { asked, closed, stopPressed } from "./questions.js";
import { check, isLoggedIn, onSession, post } from "./session.js";
import { notStopped, stopped } from "./stops.js";
import { t } from "./texts.js";

// The gateway answers after 10 s at the latest.
const ANSWER_MS = 15000;
// Without an answer it is sent again for that long, with a pause between two tries.
const STOP_MS = 30000;
const PAUSE_MS = 1000;

const open = make("button", "operate-stop", t("Stop all"));
const bar = { words: make("p"), yes: make("button", "operate-stop", t("Stop all now")), no: make("button", "operate-button", t("Cancel")) };
bar.element = make("div", "not-stopped", bar.words, make("div", "", bar.yes, " ", bar.no));
const question = { element: bar.element, end: close, asksForStop: true };
const listeners = [];
let sending = false;

/// Calls it when all drives are about to be stopped.
export const onStopAll = (listener) => listeners.push(listener);

function say(words, name = "not-stopped") {
  className(bar.element, name);
  bar.words.setAttribute("role", name.includes("information") ? "status" : "alert");
  text(bar.words, words);
  hide(bar.yes, true);
  hide(bar.no, sending);
  text(bar.no, t("Dismiss"));
}

function ask() {
  if (sending) return;
  stopPressed();
  say(t("Stop every drive that this gateway may command?"));
  hide(bar.yes, false);
  text(bar.no, t("Cancel"));
  $("stops").prepend(bar.element);
  asked(question);
  bar.yes.focus();
}

function close() {
  if (sending || !bar.element.isConnected) return;
  closed(question);
  bar.element.remove();
  open.focus({ preventScroll: true });
}

/// What the gateway says of each drive; the words for the bar, and whether all stand.
function told({ drives }) {
  const open = drives.filter(({ outcome }) => outcome !== "standing");
  for (const { drive, outcome, reason } of open) {
    notStopped(drive, "unknown", outcome === "stopping" ? t("It acknowledged the stop but is still turning.") : `${reason}.`);
  }
  for (const { drive } of drives) {
    if (!open.some((other) => other.drive === drive)) stopped(drive, t("it has stopped"));
  }
  if (!open.length) return [t("All drives have stopped: {count} of {count}, at {time}.", { count: drives.length, time: clock(new Date()) }), "not-stopped information"];
  return [t("{shown} of {count} drives are not known to have stopped.", { shown: open.length, count: drives.length })];
}

/// One try: what is said of it, or nothing where nobody answered.
async function sendOnce() {
  try {
    const { status, json } = await post("api/v1/stop", {}, ANSWER_MS);
    if (json.drives) return told(json);
    if (status === 401 || status === 403) await check();
    if (status !== 503) return [`${t("Stop all")}: ${json.error?.message ?? json.error ?? t("The gateway replied {status}.", { status })}`];
  } catch {
    // It is sent again.
  }
  return null;
}

async function send() {
  sending = true;
  closed(question);
  stopPressed();
  for (const listener of listeners) listener();
  say(t("{what}: sent …", { what: t("Stop all") }));
  bar.element.focus({ preventScroll: true });
  const begun = performance.now();
  let ended = null;
  for (;;) {
    ended = await sendOnce();
    if (ended || performance.now() - begun > STOP_MS || !isLoggedIn()) break;
    say(`${t("Stop all")}: ${t("The gateway does not respond.")} ${t("It is being sent again.")}`);
    await new Promise((done) => setTimeout(done, PAUSE_MS));
  }
  sending = false;
  say(...(ended ?? [`${t("Stop all")}: ${t("The gateway does not respond.")} ${t("Stop the drives at the machine.")}`]));
  bar.no.focus();
}

open.type = bar.yes.type = bar.no.type = "button";
open.id = "stop-all";
bar.words.setAttribute("role", "alert");
bar.element.tabIndex = -1;
open.addEventListener("click", ask);
bar.yes.addEventListener("click", send);
bar.no.addEventListener("click", close);
bar.element.addEventListener("keydown", (event) => event.key === "Escape" && close());
$("login").before(open);
const show = () => hide(open, !isLoggedIn());
onSession(show);
show();
