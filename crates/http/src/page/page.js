// The status page: which view is shown, and when it asks the gateway anew. The view stands in the address after `#`, so
// that every drive, line and recording has a link of its own.

import { $, make, text } from "./common.js";
import { answered, begin, load, Refused, unanswered, watch } from "./gateway.js";
import * as drive from "./drive.js";
import * as events from "./events.js";
import * as lines from "./lines.js";
import * as overview from "./overview.js";
import * as recording from "./recording.js";
import { language, t } from "./texts.js";

const PERIOD_MS = 1000;
const SOON_MS = 50;

// The first word of the address, what opens its view, and the entry of the navigation that it belongs to.
const VIEWS = {
  "": [overview.open, "drives"],
  drive: [drive.open, "drives"],
  lines: [lines.open, "lines"],
  line: [lines.openLine, "lines"],
  events: [events.open, "events"],
  recordings: [recording.openList, "recordings"],
  recording: [recording.open, "recordings"],
};

const gateway = document.title;
let view = null;
let timer = null;
let asking = false;
// Something was chosen while an answer was under way.
let again = false;
// How far each place was scrolled; it grows with what a person clicks.
const scrolled = new Map();

function placeOf(hash) {
  const [path, query = ""] = hash.replace(/^#\/?/, "").split("?");
  const [word, ...rest] = path.split("/");
  let name = rest.join("/");
  try {
    name = decodeURIComponent(name);
  } catch {
    // Not an address of this page; the view says that there is nothing of that name.
  }
  return { word, name, query: new URLSearchParams(query) };
}

function unknownView(root, { word }) {
  root.append(make("h1", "", t("Nothing here")), make("p", "", t("There is no page “{word}”.", { word })));
  return { title: t("Nothing here"), refresh: async () => {} };
}

function unfold(isOpen) {
  document.querySelector("header").classList.toggle("open", isOpen);
  $("menu").setAttribute("aria-expanded", String(isOpen));
}

function open(isFirst) {
  unfold(false);
  const place = placeOf(location.hash);
  const [opener, entry] = VIEWS[place.word] ?? [unknownView, ""];
  view?.close?.();
  const root = make("div", `view ${place.word || "overview"}`);
  const next = opener(root, place);
  view = { ...next, root, hash: location.hash, fresh: true };
  $("view").replaceChildren(root);
  document.title = `${next.title} · ${gateway}`;
  for (const link of document.querySelectorAll("nav a")) {
    if (link.dataset.entry === entry) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  }
  if (!isFirst) {
    // Readers of the screen begin with the heading of the new view.
    const heading = root.querySelector("h1");
    heading.tabIndex = -1;
    heading.focus({ preventScroll: true });
    window.scrollTo(0, 0);
  }
  tick();
}

async function tick() {
  clearTimeout(timer);
  if (asking) return;
  asking = true;
  const asked = view;
  const started = performance.now();
  try {
    await asked.refresh(load);
    if (asked === view) shown();
    answered();
  } catch (error) {
    if (error instanceof Refused) answered();
    else unanswered();
    if (error instanceof Refused && asked === view) refused(error);
    else console.warn("cannot read the gateway:", error);
  }
  asking = false;
  const spent = performance.now() - started;
  // A view that was opened meanwhile need not wait, a slow connection gets a rest as long as its answer took.
  const rest = again ? SOON_MS : Math.max(200, spent, PERIOD_MS - spent);
  again = false;
  if (!document.hidden) timer = setTimeout(tick, asked === view ? rest : 0);
}

// What somebody chose is shown at once, not with the next second.
function soon() {
  again = asking;
  if (asking) return;
  clearTimeout(timer);
  timer = setTimeout(tick, SOON_MS);
}

function shown() {
  $("live").hidden = false;
  $("starting").hidden = true;
  view.root.classList.remove("refused");
  view.problem?.remove();
  if (!view.fresh) return;
  view.fresh = false;
  const y = scrolled.get(view.hash);
  if (y) window.scrollTo(0, y);
}

/// What the view is about is not there (any more): nothing of it may look as if it were.
function refused(error) {
  $("live").hidden = false;
  $("starting").hidden = true;
  view.root.classList.add("refused");
  view.problem ??= make("p", "note problem");
  view.problem.setAttribute("role", "alert");
  const known = error.known.length ? ` ${t("Known: {names}.", { names: `${error.known.slice(0, 20).join(", ")}${error.known.length > 20 ? " …" : ""}` })}` : "";
  text(view.problem, `${t("The gateway replied: {message}.", { message: error.message })}${known}`);
  if (!view.problem.isConnected) view.root.querySelector("h1").after(view.problem);
}

// A hidden page does not ask. What it shows when it comes back is old until the first answer.
function visible() {
  clearTimeout(timer);
  if (document.hidden) return;
  watch();
  tick();
}

history.scrollRestoration = "manual";
document.addEventListener("visibilitychange", visible);
addEventListener("pageshow", (event) => event.persisted && visible());
addEventListener("hashchange", () => open(false));
addEventListener("scroll", () => view && !view.fresh && scrolled.set(location.hash, window.scrollY), { passive: true });
setInterval(() => document.hidden || watch(), 500);
for (const kind of ["click", "input"]) $("view").addEventListener(kind, soon);
// On a phone the pages are in a menu.
$("menu").addEventListener("click", () => unfold($("menu").getAttribute("aria-expanded") !== "true"));
addEventListener("keydown", ({ key }) => key === "Escape" && unfold(false));
$("skip").addEventListener("click", (event) => {
  event.preventDefault();
  $("view").focus();
});
// What stands in the document itself.
document.documentElement.lang = language;
for (const element of document.querySelectorAll("[data-text]")) element.textContent = t(element.textContent.trim());
for (const element of document.querySelectorAll("[data-label]")) element.setAttribute("aria-label", t(element.getAttribute("aria-label")));
begin();
open(true);
