// All drives: faults first, then warnings, then by name.

import {
  anchor, arrange, badge, blockedOf, className, directionOf, faultOf, age, hide, isOn, keyed, make, places, showSpeed, showValue, speedBar,
  stateOf, text, titleOf, valueCell, words,
} from "./common.js";
import { eventList } from "./events.js";
import { busCards, FEW_FACTS } from "./lines.js";

// Point, and the widths that have its column: all, not the phone, the desktop only.
const COLUMNS = [["actual_speed", "mid"], ["output_frequency", "all"], ["motor_speed", "far"], ["motor_current", "all"],
  ["motor_torque", "mid"], ["motor_power", "far"], ["dc_link_voltage", "far"], ["heatsink_temperature", "far"]];

// With 1,000 drives the rest of their points would be most of what the gateway sends.
const POINTS = [...COLUMNS.map(([point]) => point), "speed_reference", "frequency_reference", "reverse", "reversed", "warning", "fault_code"];
const EVENTS_SHOWN = 12;

// Tiles: the words beside the count, which drives it counts, and its colour where there are any.
const TILES = {
  online: ["online", (drive) => drive.state !== "offline", ""],
  running: ["running", (drive) => drive.state === "running", ""],
  faults: ["faults", (drive) => drive.state === "fault", "red"],
  warnings: ["warnings", (drive) => isOn(drive.points.warning), "amber"],
  offline: ["offline", (drive) => drive.state === "offline", "amber"],
};

// pump-2 stands before pump-10.
const byName = new Intl.Collator("en", { numeric: true }).compare;

/// Faults first, then warnings, then all others; the order of each is that of the names.
export function rank(drive) {
  if (drive.state === "fault") return 0;
  return isOn(drive.points.warning) ? 1 : 2;
}

// ---- A row

function cell(tag, name, ...children) {
  const element = make(tag, name, ...children);
  element.setAttribute("role", "cell");
  return element;
}

/// The controls of the drive, where the gateway serves them.
function mountOperate(element, name) {
  if (!window.Operate) return;
  const place = make("div");
  place.dataset.operate = name;
  element.append(cell("div", "operate-row", place));
  window.Operate.mount(place, name);
}

export function driveRow({ name }) {
  const row = { bus: make("span"), address: make("span", "address"), badge: make("span", "badge"), warning: make("span", "tag amber", "! warning"),
    fault: make("span", "why"), blocked: make("span", "sub blocked"), cells: [] };
  row.element = make("div", "row");
  row.element.setAttribute("role", "row");
  row.element.append(
    cell("div", "name", anchor(places.drive(name), "", name), make("span", "where", row.bus, row.address)),
    cell("div", "state", row.badge, " ", row.warning, row.fault, row.blocked),
  );
  for (const [point, width] of COLUMNS) {
    const entry = { point, ...valueCell("div", `n ${width}`) };
    entry.element.setAttribute("role", "cell");
    if (point === "actual_speed") {
      entry.bar = speedBar();
      entry.element.append(entry.bar.element, entry.bar.direction, entry.bar.reference);
    }
    // On a phone the frequency stands for the speed.
    if (point === "output_frequency") entry.element.append((row.direction = make("span", "sub direction narrow")));
    row.cells.push(entry);
    row.element.append(entry.element);
  }
  row.age = make("span", "value");
  row.quality = make("span", "tag");
  row.element.append(cell("div", "n age mid", row.age, " ", row.quality));
  mountOperate(row.element, name);
  return row;
}

export function showDrive(row, drive) {
  window.Operate?.update(drive);
  const state = stateOf(drive);
  className(row.element, `row ${state}`);
  badge(row.badge, state);
  hide(row.warning, !isOn(drive.points.warning));
  const fault = faultOf(drive);
  text(row.fault, fault);
  hide(row.fault, !fault);
  const blocked = blockedOf(drive);
  text(row.blocked, blocked);
  hide(row.blocked, !blocked);
  text(row.bus, drive.bus);
  text(row.address, ` · address ${drive.address}`);
  for (const entry of row.cells) {
    const point = drive.points[entry.point];
    showValue(entry, point, drive.age_ms);
    if (entry.bar) showSpeed(entry.bar, point, drive.points);
  }
  text(row.direction, directionOf(drive.points));
  text(row.age, age(drive.age_ms));
  text(row.quality, drive.quality === "good" ? "" : drive.quality);
  className(row.quality, `tag ${drive.quality === "good" ? "" : "grey"}`);
  hide(row.quality, drive.quality === "good");
}

// ---- Which drives are shown

function matches(drive, filter) {
  if (filter.bus && drive.bus !== filter.bus) return false;
  if (filter.tile && TILES[filter.tile] && !TILES[filter.tile][1](drive)) return false;
  if (!filter.text) return true;
  const searched = [drive.name, drive.bus, `address ${drive.address}`, drive.profile, words(stateOf(drive)), faultOf(drive), blockedOf(drive)];
  const all = searched.join(" ").toLowerCase();
  return filter.text.toLowerCase().split(/\s+/).every((word) => all.includes(word));
}

function address(filter) {
  const query = new URLSearchParams(Object.entries(filter).filter(([, value]) => value));
  return query.size ? `#/?${query}` : "#/";
}

// ---- The view

function filterBar(filter, changed) {
  const bar = { box: make("input"), bus: make("button", "chip"), count: make("p", "note") };
  bar.box.type = "search";
  bar.box.id = "filter";
  bar.box.value = filter.text;
  bar.box.placeholder = "name, line, state, fault …";
  bar.box.autocomplete = "off";
  bar.box.addEventListener("input", () => changed({ text: bar.box.value.trim() }));
  const label = make("label", "", "Filter ");
  label.htmlFor = "filter";
  bar.bus.type = "button";
  bar.bus.addEventListener("click", () => changed({ bus: "" }));
  bar.count.setAttribute("role", "status");
  bar.element = make("div", "filter", label, bar.box, bar.bus, bar.count);
  return bar;
}

function tiles(changed) {
  const list = make("ul", "tiles");
  const entries = {};
  for (const name of Object.keys(TILES)) {
    const entry = { count: make("b"), button: make("button", "", "") };
    entry.button.type = "button";
    entry.button.append(entry.count, make("span", "", TILES[name][0]));
    entry.button.addEventListener("click", () => changed(name));
    entry.element = make("li", "", entry.button);
    list.append(entry.element);
    entries[name] = entry;
  }
  return { element: list, entries };
}

function headings() {
  const row = make("div", "row head");
  row.setAttribute("role", "row");
  const add = (title, name) => {
    const element = make("div", name, title);
    element.setAttribute("role", "columnheader");
    row.append(element);
  };
  add("Drive", "name");
  add("State", "state");
  for (const [point, width] of COLUMNS) add(titleOf(point), `n ${width}`);
  add("Age", "n age mid");
  return row;
}

const LEGEND = [["value stale", "12.3"], " stale: too old or the drive is offline · ", ["value contradicted", "12.3"],
  " contradicted by a newer state · ", ["value bad", "—"], " bad: refused by the drive or never read · blank: this family does not have it"];

function frame(root) {
  const parts = { rows: make("div", "rows"), none: make("p", "note", "No drive is like that."), news: make("p", "unseen") };
  parts.rows.setAttribute("role", "rowgroup");
  const head = make("div", "", headings());
  head.setAttribute("role", "rowgroup");
  const table = make("div", "drives", head, parts.rows);
  table.setAttribute("role", "table");
  table.setAttribute("aria-label", "Drives with their state and process data");
  parts.news.setAttribute("role", "status");
  const legend = make("p", "note legend", ...LEGEND.map((part) => (Array.isArray(part) ? make("span", ...part) : part)));
  parts.lines = make("section", "", make("h2", "", "Lines"));
  parts.lines.setAttribute("aria-label", "Lines");
  parts.latest = eventList();
  parts.events = make("section", "", make("h2", "", "Latest events"), parts.latest.element, make("p", "note", anchor("#/events", "", "All events")));
  parts.events.setAttribute("aria-label", "Latest events");
  root.append(parts.news, table, parts.none, legend, parts.lines, parts.events);
  return parts;
}

export function open(root, { query }) {
  const filter = { text: query.get("text") ?? "", tile: query.get("tile") ?? "", bus: query.get("bus") ?? "" };
  const state = { drives: [], rows: new Map(), places: new Map(), faults: null };
  const changed = (change) => {
    Object.assign(filter, change);
    history.replaceState(null, "", address(filter));
    arrangeRows();
  };
  const head = make("h1", "", "Drives");
  const tileBar = tiles((name) => changed({ tile: filter.tile === name ? "" : name }));
  const bar = filterBar(filter, changed);
  root.append(head, tileBar.element, bar.element);
  const parts = frame(root);
  const cards = busCards("h3", (bus) => address({ bus }), FEW_FACTS);
  parts.lines.append(cards.element);

  function arrangeRows() {
    const { drives, rows } = state;
    let shown = 0;
    for (const drive of drives) {
      const seen = matches(drive, filter);
      hide(rows.get(drive.name).element, !seen);
      if (seen) shown += 1;
    }
    // All names are compared only when there are others; what changes is who has a fault.
    if (rows.size !== state.places.size || drives.some(({ name }) => !state.places.has(name))) {
      state.places = new Map([...rows.keys()].sort(byName).map((name, place) => [name, place]));
    }
    const order = drives.map((drive) => [rank(drive), state.places.get(drive.name), drive.name]).sort((a, b) => a[0] - b[0] || a[1] - b[1]);
    arrange(parts.rows, order.map(([, , name]) => rows.get(name).element));
    for (const [name, entry] of Object.entries(tileBar.entries)) entry.button.setAttribute("aria-pressed", String(filter.tile === name));
    hide(bar.bus, !filter.bus);
    text(bar.bus, `line ${filter.bus} ✕`);
    bar.bus.setAttribute("aria-label", `Show other lines than ${filter.bus}, too`);
    text(bar.count, shown === drives.length ? `${drives.length} drives` : `${shown} of ${drives.length} drives`);
    hide(parts.none, shown > 0 || drives.length === 0);
  }

  function showTiles() {
    for (const [name, [, test, colour]] of Object.entries(TILES)) {
      const count = state.drives.filter(test).length;
      const { count: place, element } = tileBar.entries[name];
      text(place, name === "online" ? `${count} of ${state.drives.length}` : String(count));
      className(element, count ? colour : "");
    }
  }

  // Said to those who do not see the list move.
  function announce() {
    const faults = new Map(state.drives.filter((drive) => drive.state === "fault").map((drive) => [drive.name, faultOf(drive)]));
    const anew = state.faults ? [...faults].filter(([name]) => !state.faults.has(name)) : [];
    if (anew.length) text(parts.news, anew.map(([name, fault]) => `${name}: ${fault || "fault"}`).join("; "));
    state.faults = faults;
  }

  return {
    title: "Drives",
    async refresh(load) {
      const [drives, buses, latest] = await Promise.all([
        load(`drives?points=${POINTS.join(",")}`), load("buses"), parts.latest.load(load, { limit: EVENTS_SHOWN }),
      ]);
      state.drives = drives;
      keyed(state.rows, drives, driveRow, showDrive);
      arrangeRows();
      showTiles();
      announce();
      cards.show(buses, drives);
      parts.latest.show(latest);
    },
  };
}

