// Events: lists of them, and the view that searches them.

import { anchor, arrange, hide, keyed, make, places, stamp, words } from "./common.js";

export const EVENT_COLOURS = { fault: "red", offline: "red", bus_down: "red", warning: "amber", supervision: "amber", supervision_failed: "red", unsupervised: "amber",
  refused_command: "amber", restarted: "amber", unlike_profile: "amber", not_confirmed: "amber", reload_refused: "amber",
  foreign_command: "amber", parameters_changed: "amber", restore_unfinished: "amber", diagnosis: "amber", fault_end: "green", warning_end: "green", online: "green", bus_up: "green",
  started: "blue", stopped: "blue", recording: "blue" };

// All that the gateway knows; it refuses to search for others.
const KINDS = [
  "fault", "fault_end", "warning", "warning_end", "online", "offline", "started", "stopped", "control_place", "supervision", "supervision_failed", "unsupervised",
  "refused_command", "not_confirmed", "restarted", "unlike_profile", "foreign_command", "parameters_changed", "restore_unfinished", "recording", "bus_up",
  "bus_down", "diagnosis", "reload_refused",
];
const PAGE = 100;

/// The query of these conditions; those that are empty are left out.
export function query(conditions) {
  const wanted = Object.entries(conditions).filter(([, value]) => value !== "" && value !== undefined && value !== null);
  return new URLSearchParams(wanted).toString();
}

function subjectOf(event) {
  if (event.drive) return anchor(places.drive(event.drive), "", event.drive);
  return event.bus ? anchor(places.line(event.bus), "", event.bus) : "gateway";
}

function item(event) {
  const parts = [stamp(new Date(event.time)), make("b", "", subjectOf(event)), make("span", `tag ${EVENT_COLOURS[event.event] || ""}`, words(event.event)),
    make("span", "text", event.text)];
  if (event.recording?.id) parts.push(anchor(places.recording(event.recording.id), "", "recording"));
  return make("li", "", ...parts);
}

/// A list of events, newest first.
export function eventList() {
  const list = make("ol", "events");
  const note = make("p", "note", "No events.");
  const entries = new Map();
  return {
    element: make("div", "", list, note),
    load: (load, conditions) => load(`events/log?${query(conditions)}`),
    show(events) {
      hide(note, events.length > 0);
      hide(list, events.length === 0);
      const named = events.map((event) => ({ ...event, name: `${event.boot} ${event.id}` }));
      keyed(entries, named, (event) => ({ element: item(event) }), () => {});
      arrange(list, named.map(({ name }) => entries.get(name).element));
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
    const option = make("option", "", kind ? words(kind) : "all");
    option.value = kind;
    select.append(option);
  }
  select.value = KINDS.includes(chosen) ? chosen : "";
  return select;
}

/// All events that the gateway has, searched.
export function open(root, place) {
  const given = (name) => place.query.get(name) ?? "";
  const controls = { text: input(given("text")), kind: kinds(given("kind")), drive: input(given("drive")), bus: input(given("bus")) };
  const list = eventList();
  const older = make("button", "chip", "Older");
  const newest = make("button", "chip", "Newest");
  const pages = [""];
  let next = null;
  for (const button of [older, newest]) button.type = "button";
  const conditions = () => Object.fromEntries(Object.entries(controls).map(([name, control]) => [name, control.value.trim()]));
  const changed = () => {
    pages.length = 1;
    const found = query(conditions());
    history.replaceState(null, "", found ? `#/events?${found}` : "#/events");
    view.stale = true;
  };
  for (const control of Object.values(controls)) control.addEventListener("input", changed);
  older.addEventListener("click", () => next !== null && pages.push(next) && (view.stale = true));
  newest.addEventListener("click", () => (pages.length = 1) && (view.stale = true));
  root.append(make("h1", "", "Events"), make("div", "filter",
    field("Text", controls.text, "event-text"), field("Kind", controls.kind, "event-kind"), field("Drive", controls.drive, "event-drive"), field("Line", controls.bus, "event-bus")),
  list.element, make("p", "pages", newest, " ", older));
  const view = {
    title: "Events",
    stale: true,
    async refresh(load) {
      view.stale = false;
      const before = pages[pages.length - 1];
      const reply = await list.load(load, { ...conditions(), before, limit: PAGE });
      if (view.stale) return;
      list.show(reply);
      const last = reply[PAGE - 1];
      next = last ? `${last.boot}-${last.id}` : null;
      older.disabled = next === null;
      newest.disabled = pages.length === 1;
    },
  };
  return view;
}
