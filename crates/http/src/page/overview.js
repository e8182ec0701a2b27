// All drives: faults first, then warnings, then by name; or in the order of a column, and in groups of their lines.

import {
  anchor, arrange, badge, className, faultOf, fillSpeed, hide, hint, isDirected, isOn, keyed, make, markDirection, old, places, showDirection, showValue,
  speedBar, STATES, stateOf, text, titleOf, told, valueCell, words,
} from "./common.js";
import { blockedOf } from "./causes.js";
import { eventList } from "./events.js";
import { busCards, FEW_FACTS } from "./lines.js";
import { brokerCards } from "./mqtt.js";
import { t } from "./texts.js";

// Point, and the widths that have its column: all, not the phone, the desktop only. A column that no drive fills is left out.
const COLUMNS = [["actual_speed", "speed"], ["output_frequency", "mid frequency"], ["reference", "reference"], ["motor_speed", "far"], ["motor_current", "current"],
  ["motor_torque", "mid"], ["motor_power", "far"], ["dc_link_voltage", "far"], ["heatsink_temperature", "far"]];

// With 1,000 drives the rest of their points would be most of what the gateway sends.
const POINTS = [...COLUMNS.map(([point]) => point).filter((point) => point !== "reference"), "speed_reference", "frequency_reference", "reverse", "reversed", "warning", "fault_code"];
// The column of names is as wide as the longest one, in characters, within these; each takes about so many px.
const NAME_WIDTHS = [10, 26];
const CHARACTER_PX = 9;
// On a phone the letters of a longer name are smaller.
const LONG_NAME = 14;
const EVENTS_SHOWN = 12;

// Tiles: the words beside the count, which drives it counts, and its colour where there are any.
const TILES = {
  online: [t("online"), (drive) => drive.state !== "offline", ""],
  running: [t("running"), (drive) => drive.state === "running", ""],
  faults: [t("faults"), (drive) => drive.state === "fault", "red"],
  warnings: [t("warnings"), (drive) => isOn(drive.points.warning), "amber"],
  offline: [t("offline"), (drive) => drive.state === "offline", "amber"],
};

// pump-2 stands before pump-10.
const byName = new Intl.Collator("en", { numeric: true }).compare;

/// The point in a column. A drive has its reference in percent or in Hz.
const pointIn = ({ points }, column) => (column === "reference" ? (points.speed_reference ?? points.frequency_reference) : points[column]);

/// Faults first, then warnings, then all others; the order of each is that of the names.
export function rank(drive) {
  if (drive.state === "fault") return 0;
  return isOn(drive.points.warning) ? 1 : 2;
}

// ---- The order

// Of figures the greatest comes first.
const FALLING = new Set(COLUMNS.map(([point]) => point));

/// The drives in the order of a column, `-` before its name for the other way round; those without a value come last. Without a column:
/// by rank. `places`: those of the names.
export function sorted(drives, column, places) {
  const [, turned, key] = /^(-?)(.*)$/.exec(column);
  const states = Object.keys(STATES);
  const valueOf = { "": rank, name: ({ name }) => places.get(name), state: (drive) => states.indexOf(stateOf(drive)) }[key] ?? ((drive) => pointIn(drive, key)?.value ?? null);
  const keys = drives.map((drive) => ({ drive, value: valueOf(drive), place: places.get(drive.name) }));
  const sign = turned ? -1 : 1;
  keys.sort((a, b) => (a.value === null) - (b.value === null) || sign * (a.value - b.value) || a.place - b.place);
  return keys.map(({ drive }) => drive);
}

// ---- A row

function cell(tag, name, ...children) {
  const element = make(tag, name, ...children);
  element.setAttribute("role", "cell");
  return element;
}

/// The stop of the drive, where the gateway serves controls; the others are on its page. What came of it is said in `notice`.
function mountStop(element, name, notice) {
  const place = make("div");
  element.append(cell("div", "stop", place));
  if (!window.Operate) return;
  place.dataset.operate = name;
  window.Operate.mount(place, name, notice);
}

export function driveRow({ name }) {
  const row = { bus: make("span"), address: make("span", "address"), badge: make("span", "badge"), warning: make("span", "tag amber", "! ", make("span", "word", t("warning"))), quality: make("span", "tag"),
    notice: make("span", "notice"), fault: told("span", "why"), blocked: make("span", "blocked"), cells: [] };
  row.notice.setAttribute("role", "status");
  row.second = make("span", "second", row.quality, row.notice, row.fault, row.blocked);
  row.element = make("div", "row");
  row.element.setAttribute("role", "row");
  row.element.append(
    cell("div", name.length > LONG_NAME ? "name long" : "name", anchor(places.drive(name), "", name), make("span", "where", row.bus, row.address)),
    cell("div", "state", make("span", "first", row.badge, " ", row.warning), row.second),
  );
  for (const [point, width] of COLUMNS) {
    const entry = { point, ...valueCell("div", `n ${width}`) };
    entry.element.setAttribute("role", "cell");
    if (isDirected(point)) markDirection(entry);
    if (point === "actual_speed") entry.element.append((entry.bar = speedBar()).element);
    row.cells.push(entry);
    row.element.append(entry.element);
  }
  mountStop(row.element, name, row.notice);
  return row;
}

/// The name of a line above its drives.
function groupRow({ name }) {
  const element = make("div", "group-row", cell("div", "", anchor(places.line(name), "", name)));
  element.setAttribute("role", "row");
  return { element };
}

export function showDrive(row, drive) {
  window.Operate?.update(drive);
  const state = stateOf(drive);
  // A family without a speed in percent shows its frequency in that place, where there is only one.
  className(row.element, `row ${state} ${isOn(drive.points.warning) ? "warned" : ""} ${drive.points.actual_speed ? "" : "by-frequency"}`);
  badge(row.badge, state);
  hide(row.warning, !isOn(drive.points.warning));
  const fault = faultOf(drive);
  text(row.fault, fault);
  hide(row.fault, !fault);
  const blocked = blockedOf(drive);
  text(row.blocked, blocked);
  hide(row.blocked, !blocked);
  hint(row.second, [fault, blocked].filter(Boolean).join(" · "));
  text(row.bus, drive.bus);
  const doubt = drive.profile_verified === false ? ` · ${t("not verified on hardware")}` : "";
  text(row.address, ` · ${t("address {address}", drive)}${doubt}`);
  for (const entry of row.cells) {
    const point = pointIn(drive, entry.point);
    showValue(entry, point, drive.quality);
    if (entry.direction) showDirection(entry, point, drive.points);
    if (entry.bar) fillSpeed(entry.bar, point);
  }
  text(row.quality, drive.quality === "good" ? "" : old(drive.age_ms, state === "offline" ? "" : drive.quality));
  hide(row.quality, drive.quality === "good");
}

// ---- Which drives are shown

function matches(drive, filter) {
  if (filter.bus && drive.bus !== filter.bus) return false;
  if (filter.tile && TILES[filter.tile] && !TILES[filter.tile][1](drive)) return false;
  if (!filter.text) return true;
  const searched = [drive.name, drive.bus, t("address {address}", drive), drive.profile, words(stateOf(drive)), faultOf(drive), blockedOf(drive)];
  const all = searched.join(" ").toLowerCase();
  return filter.text.toLowerCase().split(/\s+/).every((word) => all.includes(word));
}

function address(filter) {
  const query = new URLSearchParams(Object.entries(filter).filter(([, value]) => value));
  return query.size ? `#/?${query}` : "#/";
}

// ---- The view

function filterBar(filter, changed) {
  const bar = { box: make("input"), bus: make("button", "chip"), groups: make("button", "chip", t("By line")), count: make("p", "note") };
  bar.box.type = "search";
  bar.box.id = "filter";
  bar.box.value = filter.text;
  bar.box.placeholder = t("name, line, state, fault …");
  bar.box.autocomplete = "off";
  bar.box.addEventListener("input", () => changed({ text: bar.box.value.trim() }));
  const label = make("label", "", `${t("Filter")} `);
  label.htmlFor = "filter";
  bar.bus.type = "button";
  bar.bus.addEventListener("click", () => changed({ bus: "" }));
  bar.groups.type = "button";
  bar.groups.addEventListener("click", () => changed({ groups: filter.groups ? "" : "line" }));
  bar.count.setAttribute("role", "status");
  bar.element = make("div", "filter", label, bar.box, bar.bus, bar.groups, bar.count);
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

/// Headings that sort: a click on one that sorts already turns the order round, another one ends that.
function headings(filter, changed) {
  const row = make("div", "row head");
  row.setAttribute("role", "row");
  const columns = [["name", t("Drive"), "name"], ["state", t("State"), "state"], ...COLUMNS.map(([point, width]) => [point, point === "reference" ? t("Reference") : titleOf(point), `n ${width}`])];
  const cells = columns.map(([key, title, name]) => {
    const [first, second] = FALLING.has(key) ? [`-${key}`, key] : [key, `-${key}`];
    const button = make("button", "sort", title);
    button.type = "button";
    button.addEventListener("click", () => changed({ sort: { [first]: second, [second]: "" }[filter.sort] ?? first }));
    const element = make("div", name, button);
    element.setAttribute("role", "columnheader");
    row.append(element);
    return { key, element };
  });
  const stop = make("div", "stop", make("span", "unseen", t("Stop")));
  stop.setAttribute("role", "columnheader");
  row.append(stop);
  return {
    element: row,
    cells,
    show: () => cells.forEach(({ key, element }) => element.setAttribute("aria-sort", { [key]: "ascending", [`-${key}`]: "descending" }[filter.sort] ?? "none")),
  };
}

const LEGEND = [["stale", "12.3", t("stale: too old or the drive is offline")], ["contradicted", "12.3", t("contradicted by a newer state")],
  ["bad", "—", t("bad: refused by the drive or never read")], ["", "", t("blank: this family does not have it")]];

function legend() {
  const parts = LEGEND.flatMap(([quality, sample, said], place) => [place ? " · " : "", make("span", `value ${quality}`, sample), ` ${said}`]);
  return make("p", "note legend", ...parts);
}

/// Leaves out the columns that no drive fills, and makes room for the names.
function fitColumns(table, heads, { drives, rows }) {
  const filled = new Set(COLUMNS.map(([column]) => column).filter((column) => drives.some((drive) => pointIn(drive, column))));
  const shown = [...filled].join();
  for (const { key, element } of heads) if (COLUMNS.some(([column]) => column === key)) hide(element, !filled.has(key));
  for (const row of rows.values()) {
    if (row.columns === shown) continue;
    row.columns = shown;
    for (const { point, element } of row.cells) hide(element, !filled.has(point));
  }
  const [least, most] = NAME_WIDTHS;
  const longest = drives.reduce((most, { name }) => Math.max(most, name.length), least);
  const width = `${Math.round(CHARACTER_PX * Math.min(most, longest))}px`;
  if (table.nameWidth === width) return;
  table.nameWidth = width;
  table.style.setProperty("--name", width);
}

function frame(root, headingRow) {
  const parts = { rows: make("div", "rows"), none: make("p", "note", t("No matching drives.")), news: make("p", "unseen") };
  parts.rows.setAttribute("role", "rowgroup");
  const head = make("div", "", headingRow);
  head.setAttribute("role", "rowgroup");
  const table = make("div", "drives", head, parts.rows);
  table.setAttribute("role", "table");
  table.setAttribute("aria-label", t("Drives with their state and process data"));
  parts.news.setAttribute("role", "status");
  parts.lines = make("section", "", make("h2", "", t("Lines")));
  parts.lines.setAttribute("aria-label", t("Lines"));
  parts.latest = eventList();
  parts.events = make("section", "", make("h2", "", t("Latest events")), parts.latest.element, make("p", "note", anchor("#/events", "", t("All events"))));
  parts.events.setAttribute("aria-label", t("Latest events"));
  parts.table = table;
  root.append(parts.news, table, parts.none, legend(), parts.lines, parts.events);
  return parts;
}

export function open(root, { query }) {
  const filter = Object.fromEntries(["text", "tile", "bus", "sort", "groups"].map((name) => [name, query.get(name) ?? ""]));
  const state = { drives: [], rows: new Map(), groups: new Map(), places: new Map(), faults: null };
  const changed = (change) => {
    Object.assign(filter, change);
    history.replaceState(null, "", address(filter));
    arrangeRows();
  };
  const head = make("h1", "", t("Drives"));
  const tileBar = tiles((name) => changed({ tile: filter.tile === name ? "" : name }));
  const bar = filterBar(filter, changed);
  root.append(head, tileBar.element, bar.element);
  const heads = headings(filter, changed);
  const parts = frame(root, heads.element);
  const cards = busCards("h3", (bus) => address({ bus }), FEW_FACTS);
  const brokers = brokerCards("h3");
  parts.lines.append(cards.element, brokers.element);

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
    arrange(parts.rows, grouped(sorted(drives, filter.sort, state.places)));
    heads.show();
    bar.groups.setAttribute("aria-pressed", String(filter.groups === "line"));
    for (const [name, entry] of Object.entries(tileBar.entries)) entry.button.setAttribute("aria-pressed", String(filter.tile === name));
    hide(bar.bus, !filter.bus);
    text(bar.bus, `${t("line {line}", { line: filter.bus })} ✕`);
    bar.bus.setAttribute("aria-label", t("Also show lines other than {line}", { line: filter.bus }));
    text(bar.count, shown === drives.length ? t("{count} drives", { count: shown }) : t("{shown} of {count} drives", { shown, count: drives.length }));
    hide(parts.none, shown > 0 || drives.length === 0);
  }

  // Whether somebody may be about to press something in the list, which then keeps its order.
  function isAimedAt() {
    return document.body.classList.contains("operating") && parts.rows.matches(":hover") && state.drives.every(({ name }) => state.rows.get(name).element.isConnected);
  }

  // The elements of these drives, each group below the name of its line.
  function grouped(order) {
    const { rows, groups } = state;
    const lines = filter.groups === "line" ? [...new Set(order.map(({ bus }) => bus))].sort(byName) : [];
    keyed(groups, lines.map((name) => ({ name })), groupRow, () => {});
    const elementOf = (drive) => rows.get(drive.name).element;
    if (!lines.length) return order.map(elementOf);
    return lines.flatMap((line) => {
      const own = order.filter(({ bus }) => bus === line).map(elementOf);
      hide(groups.get(line).element, own.every((element) => element.hidden));
      return [groups.get(line).element, ...own];
    });
  }

  function showTiles() {
    for (const [name, [, test, colour]] of Object.entries(TILES)) {
      const count = state.drives.filter(test).length;
      const { count: place, element } = tileBar.entries[name];
      text(place, name === "online" ? t("{shown} of {count}", { shown: count, count: state.drives.length }) : String(count));
      className(element, count ? colour : "");
    }
  }

  // Said to those who do not see the list move.
  function announce() {
    const faults = new Map(state.drives.filter((drive) => drive.state === "fault").map((drive) => [drive.name, faultOf(drive)]));
    const anew = state.faults ? [...faults].filter(([name]) => !state.faults.has(name)) : [];
    if (anew.length) text(parts.news, anew.map(([name, fault]) => `${name}: ${fault || t("fault")}`).join("; "));
    state.faults = faults;
  }

  return {
    title: t("Drives"),
    async refresh(load) {
      const [drives, buses, latest, mqtt] = await Promise.all([
        load(`drives?points=${POINTS.join(",")}`), load("buses"), parts.latest.load(load, { limit: EVENTS_SHOWN }), load("mqtt"),
      ]);
      state.drives = drives;
      keyed(state.rows, drives, driveRow, showDrive);
      fitColumns(parts.table, heads.cells, state);
      if (!isAimedAt()) arrangeRows();
      showTiles();
      announce();
      cards.show(buses, drives);
      brokers.show(mqtt);
      parts.latest.show(latest);
    },
  };
}

