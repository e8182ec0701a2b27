// Requests to the gateway, and whether it answers.

import { $, className, clock, hide, text } from "./common.js";
import { t } from "./texts.js";

const LOST_MS = 3500;
const FETCH_MS = 4000;

/// The gateway answered that there is nothing of the kind, or that it cannot.
export class Refused extends Error {
  constructor(status, reply) {
    super(reply.error || `status ${status}`);
    this.status = status;
    this.known = reply.known || [];
  }
}

let lastGood = -Infinity;
let lastGoodTime = null;
let lost = null;
// Requests without an answer since the last one that had one.
let tries = 0;
const returning = [];
const losing = [];

/// Calls it when the gateway answers again after a request without an answer: it may be another one by then.
export const onReturn = (listener) => returning.push(listener);

/// Calls it when nothing was heard of the gateway for a while, and the page is greyed.
export const onLost = (listener) => losing.push(listener);

/// JSON at `path`, below `api/v1/`. Throws `Refused` where the gateway answers that it has none.
export async function load(path, limit = FETCH_MS) {
  const reply = await fetch(`api/v1/${path}`, { headers: { Accept: "application/json" }, cache: "no-store", signal: AbortSignal.timeout(limit) });
  if (reply.ok) return reply.json();
  if (reply.status === 503) throw new Error(`${path}: 503`);
  throw new Refused(reply.status, await reply.json().catch(() => ({})));
}

/// Everything on the page is of this moment.
export function answered() {
  lastGood = performance.now();
  lastGoodTime = new Date();
  const returns = tries > 0;
  tries = 0;
  show(false);
  if (returns) for (const listener of returning) listener();
}

/// The gateway did not answer.
export function unanswered() {
  tries += 1;
  showTries();
}

/// Looks whether the gateway was heard of lately; what is older is greyed.
export function watch() {
  if (performance.now() - lastGood > LOST_MS) show(true);
}

/// Forgets what was heard so far: a page that opens has some seconds for its first answer.
export function begin() {
  lastGood = performance.now();
}

function show(isLost) {
  if (lost === isLost) return;
  lost = isLost;
  document.body.classList.toggle("lost", lost);
  className($("link"), `pill ${lost ? "red" : ""}`);
  hide($("link"), false);
  text($("link-text"), lost ? t("Connection lost") : t("Live"));
  const since = lastGoodTime ? t("No connection to the gateway since {time}.", { time: clock(lastGoodTime) }) : t("No connection to the gateway yet.");
  hide($("banner"), !lost);
  text($("banner-text"), lost ? `${since} ${t("The data below is out of date.")}` : "");
  showTries();
  if (lost) for (const listener of losing) listener();
}

// Beside what is announced: it changes with every try.
function showTries() {
  text($("banner-tries"), tries ? t("No reply to {count} requests, the last at {time}; retrying.", { count: tries, time: clock(new Date()) }) : "");
}
