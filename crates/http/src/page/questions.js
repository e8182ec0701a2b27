// The questions of the page, asked before something is sent. They end with Escape, with the session, and when nobody sees what
// they ask about: the page is hidden, shows another view, or has lost the gateway. Any stop ends those that do not ask for one.
//
// A key that is held down repeats itself. No repetition presses anything on this page, and the key that opened a question answers
// it only after it was released.

import { onLost } from "./gateway.js";
import { onSession } from "./session.js";
import { t } from "./texts.js";

const open = new Set();
const down = new Set();

/// `question` is asked now: `element` is its place, `end` closes it and gets the reason in words, if there is one to tell.
/// `asksForStop`: it asks whether to stop.
export function asked(question) {
  for (const other of open) if (!other.element.isConnected) open.delete(other);
  question.keys = new Set(down);
  open.add(question);
}

/// A question is closed.
export const closed = (question) => open.delete(question);

function end(which, why) {
  for (const question of [...open].filter(which)) {
    closed(question);
    question.end(why);
  }
}

const all = () => true;

/// Somebody pressed a stop here, of whatever drive.
export const stopPressed = () => end(({ asksForStop }) => !asksForStop, t("a stop was pressed"));

// ---- Keys

const isTyped = (element) => element instanceof HTMLInputElement && element.type !== "radio";

addEventListener("keydown", (event) => {
  if (event.key === "Escape") return end(all);
  const presses = event.key === "Enter" || (event.key === " " && !isTyped(event.target));
  const opened = [...open].some(({ element, keys }) => keys.has(event.code) && element.contains(event.target));
  if (presses && (event.repeat || opened)) event.preventDefault();
  if (!event.repeat) down.add(event.code);
}, { capture: true });

function released(codes) {
  for (const keys of [down, ...[...open].map((question) => question.keys)]) {
    for (const code of codes) keys.delete(code);
  }
}

addEventListener("keyup", ({ code }) => released([code]), { capture: true });
// Where the keys are released is not seen by a page without the focus.
addEventListener("blur", () => released([...down]));

// ---- What nobody sees

onSession(() => end(all));
onLost(() => end(all, t("the connection to the gateway was lost")));
addEventListener("hashchange", () => end(all));
document.addEventListener("visibilitychange", () => document.hidden && end(all));
