// Stops that were not carried out: a banner over everything, until somebody dismisses it. A stop that fails must not be missed. Banners
// lie over the lower end of the window: one that comes or goes moves nothing that somebody is about to press.

import { $, className, clock, make, text } from "./common.js";
import { t } from "./texts.js";

const open = new Map();

/// How sure it is that the drive was not stopped, in words.
const TITLES = {
  refused: (drive) => t("{drive} was not stopped", { drive }),
  unknown: (drive) => t("{drive} may not have stopped", { drive }),
};

function build(drive) {
  const alert = { drive, title: make("b"), why: make("span"), tries: make("span", "tries"), close: make("button", "operate-button", t("Dismiss")) };
  const said = make("p", "", alert.title, " ", make("strong", "", t("Stop it at the machine.")), " ", alert.why);
  said.setAttribute("role", "alert");
  alert.close.type = "button";
  alert.close.setAttribute("aria-label", t("Dismiss: the stop of {drive}", { drive }));
  alert.close.addEventListener("click", () => dismiss(alert));
  alert.element = make("div", "not-stopped", make("div", "", said, alert.tries), alert.close);
  return alert;
}

function dismiss(alert) {
  alert.element.remove();
  alert.dismissed = alert.certainty;
  const next = $("stops").querySelector("button") ?? $("view");
  next.focus({ preventScroll: true });
}

/// The stop of a drive was not carried out, or nobody knows: `refused` or `unknown`, and why. `tries` is said besides and may change
/// with each of them.
export function notStopped(drive, certainty, why, tries = "") {
  const alert = open.get(drive) ?? open.set(drive, build(drive)).get(drive);
  if (alert.ended || alert.dismissed !== certainty) {
    alert.dismissed = null;
    if (!alert.element.isConnected) $("stops").prepend(alert.element);
  }
  Object.assign(alert, { certainty, ended: false });
  className(alert.element, "not-stopped");
  text(alert.title, `■ ${TITLES[certainty](drive)}.`);
  text(alert.why, why);
  text(alert.tries, tries);
}

/// A later stop of the drive was carried out. Until somebody dismisses it, the banner says both.
export function stopped(drive, words) {
  const alert = open.get(drive);
  if (!alert) return;
  alert.ended = true;
  className(alert.element, "not-stopped ended");
  text(alert.tries, t("The stop sent at {time} was carried out: {words}", { time: clock(new Date()), words }));
}

// The end of the page can be scrolled to above the banners.
new ResizeObserver(([{ contentRect }]) => document.documentElement.style.setProperty("--alerts", `${contentRect.height}px`)).observe($("alerts"));
