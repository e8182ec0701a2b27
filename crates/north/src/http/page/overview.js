// All drives: faults first, then warnings, then by name; or in the order of a column, and in groups of their lines.

import {
  anchor, arrange, badge, blockedOf, className, directionOf, faultOf, hide, isOn, keyed, make, old, places, showSpeed, showValue, speedBar,
  STATES, stateOf, text, titleOf, told, valueCell, words,
} from "./common.js";
import { eventList } from "./events.js";
import { busCards, FEW_FACTS } from "./lines.js";
import { t } from "./texts.js";

// Point, and the widths that have its column: all, not the phone, the desktop only.
const COLUMNS = [["actual_speed", "mid"], ["output_frequency", "all"], ["motor_speed", "far"], ["motor_current", "all"],
  ["motor_torque", "mid"], ["motor_power", "far"], ["dc_link_voltage", "far"], ["heatsink_temperature", "far"]];

// With 1,000 drives the rest of their points would be most of what the gateway sends.
const POINTS = [...COLUMNS.map(([point]) => point), "speed_reference", "frequency_reference", "reverse", "reversed", "warning", "fault_code"];
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
  const valueOf = { "": rank, name: ({ name }) => places.get(name), state: (drive) => states.indexOf(stateOf(drive)) }[key] ?? ((drive) => drive.points[key]?.value ?? null);
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

/// The controls of the drive, where the gateway serves them.
function mountOperate(element, name) {
  if (!window.Operate) return;
  const place = make("div");
  place.dataset.operate = name;
  element.append(cell("div", "operate-row", place));
  window.Operate.mount(place, name);
}

export function driveRow({ name }) {
  const row = { bus: make("span"), address: make("span", "address"), badge: make("span", "badge"), warning: make("span", "tag amber", `! ${t("warning")}`), quality: make("span", "tag grey"),
    fault: told("span", "why"), blocked: make("span", "sub blocked"), cells: [] };
  row.element = make("div", "row");
  row.element.setAttribute("role", "row");
  row.element.append(
    cell("div", "name", anchor(places.drive(name), "", name), make("span", "where", row.bus, row.address)),
    cell("div", "state", row.badge, " ", row.warning, " ", row.quality, row.fault, row.blocked),
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
  mountOperate(row.element, name);
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
  const doubt = drive.profile_verified === false ? ` · ${t("not verified on hardware")}` : "";
  text(row.address, ` · ${t("address {address}", drive)}${doubt}`);
  for (const entry of row.cells) {
    const point = drive.points[entry.point];
    showValue(entry, point, drive.quality);
    if (entry.bar) showSpeed(entry.bar, point, drive.points);
  }
  text(row.direction, directionOf(drive.points));
  text(row.quality, drive.quality === "good" ? "" : old(drive.age_ms, drive.quality));
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
  const columns = [["name", t("Drive"), "name"], ["state", t("State"), "state"], ...COLUMNS.map(([point, width]) => [point, titleOf(point), `n ${width}`])];
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
  return {
    element: row,
    show: () => cells.forEach(({ key, element }) => element.setAttribute("aria-sort", { [key]: "ascending", [`-${key}`]: "descending" }[filter.sort] ?? "none")),
  };
}

const LEGEND = [["stale", "12.3", t("stale: too old or the drive is offline")], ["contradicted", "12.3", t("contradicted by a newer state")],
  ["bad", "—", t("bad: refused by the drive or never read")], ["", "", t("blank: this family does not have it")]];

function legend() {
  const parts = LEGEND.flatMap(([quality, sample, said], place) => [place ? " · " : "", make("span", `value ${quality}`, sample), ` ${said}`]);
  return make("p", "note legend", ...parts);
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

