// Events: lists of them, and the view that searches them.

import { anchor, arrange, faultWithoutText, hide, keyed, make, places, stamp, told, words } from "./common.js";
import { load } from "./gateway.js";
import { t } from "./texts.js";

export const EVENT_COLOURS = { fault: "red", offline: "amber", bus_down: "red", warning: "amber", supervision: "amber", supervision_failed: "red", unsupervised: "amber",
  refused_command: "amber", restarted: "amber", unlike_profile: "amber", selection_differs: "amber", not_confirmed: "amber", reload_refused: "amber",
  foreign_command: "amber", parameters_changed: "amber", restore_unfinished: "amber", diagnosis: "amber", guarded: "amber", interlock: "amber", slot_void: "amber", paused: "amber" };

// All that the gateway knows; it refuses to search for others.
const KINDS = [
  "fault", "fault_end", "warning", "warning_end", "online", "offline", "started", "stopped", "control_place", "supervision", "supervision_failed", "unsupervised",
  "refused_command", "guarded", "interlock", "not_confirmed", "restarted", "unlike_profile", "selection_differs", "foreign_command", "parameters_changed", "restore_unfinished", "recording",
  "held", "released", "hold_broken", "slot_void", "drill", "paused", "bus_up",
  "bus_down", "diagnosis", "reload_refused",
];
const PAGE = 100;
// A file has at most so many events; the gateway gives that many at once.
const MOST_SAVED = 20000;
const SAVED_AT_ONCE = 1000;

/// The query of these conditions; those that are empty are left out.
export function query(conditions) {
  const wanted = Object.entries(conditions).filter(([, value]) => value !== "" && value !== undefined && value !== null);
  return new URLSearchParams(wanted).toString();
}

function subjectOf(event) {
  if (event.drive) return anchor(places.drive(event.drive), "", event.drive);
  return event.bus ? anchor(places.line(event.bus), "", event.bus) : t("gateway");
}

/// The text of an event without the name that stands before it, or at the top of the page.
export function textOf({ text, drive, bus, recording }) {
  const [kind, name] = drive ? ["drive", drive] : ["bus", bus];
  if (!name) return text;
  const known = [`${kind} ${name} `, recording?.id && `recording ${recording.id}`].find((words) => words && text.startsWith(words)) ?? "";
  const rest = text.slice(known.length).replace(/^: /, "");
  const [, code] = /^has fault (\d+): \1$/.exec(rest) ?? [];
  if (code) return faultWithoutText(code);
  return rest.replaceAll(` of ${kind} ${name}`, "").replaceAll(` of ${name} `, " ").replaceAll(`${kind} ${name}`, `the ${kind}`);
}

function item(event, named) {
  const parts = [stamp(new Date(event.time)), ...(named ? [make("b", "", subjectOf(event))] : []), make("span", `tag ${EVENT_COLOURS[event.event] || ""}`, words(event.event)),
    told("span", "text", textOf(event))];
  if (event.recording?.id) parts.push(anchor(places.recording(event.recording.id), "", t("recording")));
  return make("li", "", ...parts);
}

/// A list of events, newest first; `named`: each with what it is about.
export function eventList(named = true) {
  const list = make("ol", "events");
  const note = make("p", "note", t("No events."));
  const entries = new Map();
  return {
    element: make("div", "", list, note),
    load: (load, conditions) => load(`events/log?${query(conditions)}`),
    show(events) {
      hide(note, events.length > 0);
      hide(list, events.length === 0);
      const items = events.map((event) => ({ ...event, name: `${event.boot} ${event.id}` }));
      keyed(entries, items, (event) => ({ element: item(event, named) }), () => {});
      arrange(list, items.map(({ name }) => entries.get(name).element));
    },
  };
}

function field(label, control, id) {
  control.id = id;
  const caption = make("label", "", `${label} `);
  caption.htmlFor = id;
  return make("div", "field", caption, control);
}

function input(value) {
  const element = make("input");
  element.type = "search";
  element.value = value;
  element.autocomplete = "off";
  return element;
}

function kinds(chosen) {
  const select = make("select");
  for (const kind of ["", ...KINDS]) {
    const option = make("option", "", kind ? words(kind) : t("all"));
    option.value = kind;
    select.append(option);
  }
  select.value = KINDS.includes(chosen) ? chosen : "";
  return select;
}

function moment(value) {
  const element = make("input");
  element.type = "datetime-local";
  element.value = value;
  return element;
}

const quoted = (value) => `"${String(value ?? "").replaceAll('"', '""')}"`;

/// Events as a table for other programs, oldest first.
function csvOf(events) {
  const lines = events.map(({ time, event, bus, drive, text }) => [time, event, bus, drive, text].map(quoted).join(","));
  return ["time,event,bus,drive,text", ...lines.reverse(), ""].join("\r\n");
}

function save(name, content) {
  const link = anchor(URL.createObjectURL(new Blob([content], { type: "text/csv" })), "");
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
}

/// All events that the gateway has, searched.
export function open(root, place) {
  const given = (name) => place.query.get(name) ?? "";
  const controls = { text: input(given("text")), kind: kinds(given("kind")), drive: input(given("drive")), bus: input(given("bus")), from: moment(given("from")), to: moment(given("to")) };
  const list = eventList();
  const older = make("button", "chip", t("Older"));
  const newest = make("button", "chip", t("Newest"));
  const pages = [""];
  let next = null;
  const csv = make("button", "chip", t("Save as CSV"));
  for (const button of [older, newest, csv]) button.type = "button";
  const conditions = () => Object.fromEntries(Object.entries(controls).map(([name, control]) => [name, control.value.trim()]));
  const timeOf = (control) => (control.value ? new Date(control.value).getTime() : null);
  // Up to `limit` events before the one named, or before the end of the chosen time; `next` names the last where there may be more.
  async function read(load, from, limit) {
    const { from: begin, to: end, ...wanted } = conditions();
    const until = timeOf(controls.to);
    const reply = await list.load(load, { ...wanted, before: from || (end && until / 1000), limit });
    const events = reply.filter(({ time }) => !begin || Date.parse(time) >= timeOf(controls.from));
    const last = events.length === limit ? events[limit - 1] : null;
    return { events, next: last && `${last.boot}-${last.id}` };
  }
  async function saveAll() {
    csv.disabled = true;
    const all = [];
    try {
      for (let from = ""; from !== null && all.length < MOST_SAVED;) {
        const { events, next } = await read(load, from, SAVED_AT_ONCE);
        all.push(...events);
        from = next;
      }
      save("events.csv", csvOf(all));
    } catch (error) {
      console.warn("cannot read the events:", error);
    }
    csv.disabled = false;
  }
  csv.addEventListener("click", saveAll);
  const changed = () => {
    pages.length = 1;
    const found = query(conditions());
    history.replaceState(null, "", found ? `#/events?${found}` : "#/events");
    view.stale = true;
  };
  for (const control of Object.values(controls)) control.addEventListener("input", changed);
  older.addEventListener("click", () => next !== null && pages.push(next) && (view.stale = true));
  newest.addEventListener("click", () => (pages.length = 1) && (view.stale = true));
  root.append(make("h1", "", t("Events")), make("div", "filter",
    field(t("Text"), controls.text, "event-text"), field(t("Kind"), controls.kind, "event-kind"), field(t("Drive"), controls.drive, "event-drive"), field(t("Line"), controls.bus, "event-bus"),
    field(t("From"), controls.from, "event-from"), field(t("To"), controls.to, "event-to")),
  list.element, make("p", "pages", newest, " ", older, " ", csv));
  const view = {
    title: t("Events"),
    stale: true,
    async refresh(load) {
      view.stale = false;
      const found = await read(load, pages[pages.length - 1], PAGE);
      if (view.stale) return;
      list.show(found.events);
      next = found.next;
      older.disabled = next === null;
      newest.disabled = pages.length === 1;
    },
  };
  return view;
}
