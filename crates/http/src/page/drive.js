// One drive: what it does and why, its trends, what the gateway counted, all its points, who commanded it, what happened, and how
// well the line carries it.

import {
  anchor, badge, className, clock, faultOf, figure, fillRows, hide, hours, isDirected, isOn, keyed, make, markDirection, old, places, section,
  opening, showDirection, showSpeed, showValue, size, speedBar, stamp, stateOf, table, text, titleOf, told, valueCell, words,
} from "./common.js";
import { causesTitle, causeText } from "./causes.js";
import { EVENT_COLOURS, eventList, textOf } from "./events.js";
import { failures } from "./lines.js";
import { minuteAxis, minutes } from "./strips.js";
import { decimal, t } from "./texts.js";
import { trends } from "./trend.js";

const SLOW_MS = 4000;
const MAIN = ["actual_speed", "output_frequency", "motor_speed", "motor_current", "motor_torque", "motor_power", "dc_link_voltage",
  "heatsink_temperature"];

// The common model in groups; what a profile has beyond it follows by its kind.
const GROUPS = [
  [t("State"), ["ready", "running", "reversed", "fault", "warning", "at_reference", "zero_speed", "remote", "fault_code"]],
  [t("Process data"), ["actual_speed", "output_frequency", "motor_speed", "motor_current", "motor_torque", "motor_power", "motor_voltage",
    "dc_link_voltage", "heatsink_temperature"]],
  [t("Commands and references"), ["run", "reverse", "fault_reset", "speed_reference", "frequency_reference"]],
  [t("Counters"), ["energy", "operating_hours"]],
];
const OWN_BITS = t("More states");
const OWN = t("More of this family");

function groupOf(name, point) {
  const group = GROUPS.find(([, names]) => names.includes(name));
  if (group) return group[0];
  return typeof point.value === "boolean" && !point.text ? OWN_BITS : OWN;
}

// ---- All points, grouped

function pointList() {
  const element = section("points", t("Points"));
  const groups = new Map();
  for (const name of [...GROUPS.map(([title]) => title), OWN_BITS, OWN]) {
    const list = make("dl", "points");
    const group = make("div", "group", make("h3", "", name), list);
    groups.set(name, { group, list });
    element.append(group);
  }
  const entries = new Map();
  const create = ({ name, point }) => {
    const entry = valueCell("dd", "");
    entry.dd = entry.element;
    entry.point = name;
    if (isDirected(name)) markDirection(entry);
    entry.group = groupOf(name, point);
    entry.element = make("div", "", make("dt", "", words(name)), entry.dd);
    groups.get(entry.group).list.append(entry.element);
    return entry;
  };
  return {
    element,
    show(points) {
      // A reload may have given the drive another profile.
      keyed(entries, Object.entries(points).map(([name, point]) => ({ name, point })), create, (entry, { name, point }) => {
        const group = groupOf(name, point);
        // A point that was never read has no kind yet.
        if (group !== entry.group) groups.get((entry.group = group)).list.append(entry.element);
        showValue(entry, point);
        if (entry.direction) showDirection(entry, point, points);
      });
      for (const { group, list } of groups.values()) hide(group, list.childElementCount === 0);
    },
  };
}

// ---- What it does and why

function whyPanel() {
  const list = make("ul", "causes");
  const element = section("why", t("Why it does not run"), list);
  return {
    element,
    show(drive) {
      const { why: causes } = drive;
      hide(element, causes.length === 0);
      text(element.firstChild, causesTitle(drive));
      className(element, `panel why-panel ${drive.state === "running" ? "quiet" : ""}`);
      while (list.children.length > causes.length) list.lastChild.remove();
      while (list.children.length < causes.length) list.append(make("li", "", make("b"), make("span", "said"), make("span", "remedy"), told("span", "evidence")));
      causes.forEach((cause, place) => {
        const { name, said, todo, evidence } = causeText(cause, drive, faultOf(drive));
        [name, said, todo, evidence].forEach((part, at) => text(list.children[place].children[at], part));
      });
    },
  };
}

function figures() {
  const element = make("dl", "figures");
  const cells = MAIN.map((point) => {
    const cell = { point, ...valueCell("dd", "") };
    if (point === "actual_speed") {
      cell.bar = speedBar();
      cell.element.append(cell.bar.element, cell.bar.direction, cell.bar.reference);
    } else if (isDirected(point)) {
      markDirection(cell);
    }
    cell.box = make("div", "", make("dt", "", titleOf(point)), cell.element);
    element.append(cell.box);
    return cell;
  });
  return {
    element,
    show(drive) {
      for (const cell of cells) {
        const point = drive.points[cell.point];
        hide(cell.box, !point);
        showValue(cell, point, drive.quality);
        if (cell.bar) showSpeed(cell.bar, point, drive.points);
        if (cell.direction) showDirection(cell, point, drive.points);
      }
    },
  };
}

function top(name) {
  const parts = { badge: make("span", "badge"), warning: make("span", "tag amber", `! ${t("warning")}`), quality: make("span", "tag"), fault: told("p", "why"),
    where: make("p", "where") };
  parts.element = make("div", "top", make("p", "crumbs", anchor("#/", "", t("Drives")), " › "), make("h1", "", name), parts.where, make("p", "state", parts.badge, " ", parts.warning, " ", parts.quality));
  return parts;
}

function showTop(parts, drive) {
  badge(parts.badge, stateOf(drive));
  hide(parts.warning, !isOn(drive.points.warning));
  const fault = faultOf(drive);
  text(parts.fault, fault);
  hide(parts.fault, !fault);
  text(parts.quality, drive.quality === "good" ? "" : old(drive.age_ms, drive.quality));
  hide(parts.quality, drive.quality === "good");
  const access = drive.access === "control" ? t("accepts commands") : t("read-only");
  const line = anchor(places.line(drive.bus), "", drive.bus);
  if (parts.known === JSON.stringify([drive.bus, drive.address, drive.unit, drive.profile, access])) return;
  parts.known = JSON.stringify([drive.bus, drive.address, drive.unit, drive.profile, access]);
  const doubt = drive.profile_verified === false ? ` (${t("not verified on hardware")})` : "";
  parts.where.replaceChildren(line, ` · ${t("address {address}", drive)} · ${t("Modbus TCP unit {unit}", drive)} · ${drive.profile}${doubt} · ${access}`);
}

// ---- What the gateway counted, and the line

/// Figures by name, with their titles.
function factList(titles) {
  const values = new Map();
  const element = make("dl", "facts");
  for (const [name, title] of Object.entries(titles)) {
    const value = make("dd", "value");
    values.set(name, value);
    element.append(make("div", "", make("dt", "", title), value));
  }
  return { element, set: (name, value) => text(values.get(name), value) };
}

const isKnown = (value) => value !== null && value !== undefined;

function showCounters(facts, drive) {
  const { starts, running_seconds: running, energy_kwh: energy } = drive;
  facts.set("running", isKnown(running) ? hours(running) : t("unknown"));
  facts.set("starts", isKnown(starts) ? String(starts) : t("unknown"));
  facts.set("energy", isKnown(energy) ? `${figure(energy, "kWh")} kWh` : t("unknown"));
}

/// What drills have proven of its stops.
function showStops(element, stops) {
  hide(element, !stops?.length);
  const ways = { order: t("a stop command"), client: t("a silent client"), gateway: t("a silent gateway") };
  const said = ({ kind, passed, age_s: seconds, due }) => {
    if (passed === null) return `${ways[kind]}: ${t("never tested")}`;
    const result = passed ? t("stopped in time") : t("did not stop in time");
    return `${ways[kind]}: ${result}, ${t("{age} ago", { age: hours(seconds) })}${due ? `, ${t("due")}` : ""}`;
  };
  text(element, `${t("Stops proven by drills")}: ${(stops ?? []).map(said).join(" · ")}`);
}

function showLine(facts, drive) {
  const { ok, exception, timeout, corrupt } = drive.transactions;
  const total = ok + exception + timeout + corrupt;
  const share = total ? ` (${decimal((100 * (timeout + corrupt)) / total, 2)} %)` : "";
  const since = drive.since ? `, ${t("since {time}", { time: clock(new Date(drive.since)) })}` : "";
  facts.set("online", `${drive.online ? t("yes") : t("no")}${since}`);
  facts.set("exchanges", String(total));
  facts.set("invalid", `${timeout + corrupt}${share}`);
  facts.set("failures", failures(drive.transactions));
  facts.set("turnaround", drive.turnaround_ms === null ? t("unknown") : `${decimal(drive.turnaround_ms, 1)} ms`);
}

// ---- Commands, recordings

function commandRow(record) {
  const cells = [stamp(new Date(record.time)), record.command, words(record.source), record.client, `${words(record.result)}${record.count > 1 ? ` ×${record.count}` : ""}`,
    `${record.latency_ms.toFixed(0)} ms`];
  const row = make("tr", "", ...cells.map((cell) => make("td", "", cell)));
  row.title = record.text;
  return row;
}

function recordingRow(record) {
  const place = places.recording(record.id);
  return opening(make("tr", "", make("td", "", stamp(new Date(record.time))), make("td", "", anchor(place, "", words(record.trigger))),
    told("td", "", record.summary), make("td", "n", size(record.bytes))), place);
}

function log(id, title, none, columns, row) {
  const list = table(title, ...columns);
  const note = make("p", "note", none);
  const entries = new Map();
  return {
    element: section(id, title, list.element, note),
    show(records) {
      hide(list.element, records.length === 0);
      hide(note, records.length > 0);
      fillRows(entries, list.body, records, row);
    },
  };
}

// ---- The view

export function open(root, { name }) {
  const parts = {
    top: top(name), figures: figures(), why: whyPanel(), trends: trends(name), points: pointList(), operate: make("div", "operate"),
    counters: factList({ running: t("Run time"), starts: t("Starts"), energy: t("Energy") }),
    line: factList({ online: t("Online"), exchanges: t("Transactions"), invalid: t("Without a valid reply"), failures: t("Failures"), turnaround: t("Turnaround") }),
    commands: log("commands", t("Commands"), t("No commands to this drive."), [t("Time"), t("Command"), t("By"), t("Client"), t("Result"), t("Duration")], commandRow),
    recordings: log("recordings", t("Recordings"), t("There is no recording of this drive."), [t("Time"), t("Trigger"), t("Summary"), t("Size")], recordingRow),
    events: eventList(false), strip: make("div", "strip-bars"), stops: make("p", "note"),
  };
  parts.operate.dataset.operate = name;
  const counters = section("counters", t("Counted by the gateway"), parts.counters.element, parts.stops);
  const line = section("line", t("Line"), parts.line.element, make("p", "note", t("Errors by minute, the last hour")), parts.strip, minuteAxis());
  const events = section("drive-events", t("Events"), parts.events.element, make("p", "note", anchor(`#/events?drive=${encodeURIComponent(name)}`, "", t("All events of this drive"))));
  // Reasons come and go: they stand below the controls, so that a stop keeps its place.
  root.append(parts.top.element, parts.operate, parts.top.fault, parts.why.element, parts.figures.element, parts.trends.element,
    make("div", "pair", counters, line), parts.points.element, parts.commands.element, make("div", "pair", events, parts.recordings.element));
  window.Operate?.mount(parts.operate, name);
  let slow = 0;

  async function refreshSlow(load, drive) {
    slow = performance.now() + SLOW_MS;
    const named = `drive=${encodeURIComponent(name)}`;
    const [events, commands, recordings, bus] = await Promise.all([
      parts.events.load(load, { drive: name, limit: 20 }), load(`audit?${named}`), load("recordings"), load(`buses/${encodeURIComponent(drive.bus)}`),
    ]);
    parts.events.show(events);
    // Starts and stops show in the curves.
    const marked = events.filter((event) => ["red", "amber"].includes(EVENT_COLOURS[event.event]));
    parts.marks = marked.map((event) => ({ t: Date.parse(event.time), colour: EVENT_COLOURS[event.event], text: textOf(event) }));
    parts.commands.show(commands.slice(-20).reverse());
    parts.recordings.show(recordings.filter((record) => record.drive === name).slice(-20).reverse());
    showMinutes(parts.strip, bus, name);
  }

  return {
    title: name,
    async refresh(load) {
      const drive = await load(`drives/${encodeURIComponent(name)}`);
      showTop(parts.top, drive);
      parts.figures.show(drive);
      parts.why.show(drive);
      parts.points.show(drive.points);
      showCounters(parts.counters, drive);
      showStops(parts.stops, drive.stops);
      showLine(parts.line, drive);
      window.Operate?.update(drive);
      if (performance.now() >= slow) await refreshSlow(load, drive);
      await parts.trends.refresh(load, parts.marks ?? [], drive.points);
      parts.trends.showNow(drive.points);
    },
  };
}

function showMinutes(place, bus, name) {
  const own = bus.by_drive.find((item) => item.drive === name);
  const state = JSON.stringify(own?.errors ?? null);
  if (place.state === state) return;
  place.state = state;
  place.replaceChildren(own ? minutes(own.errors, t("errors")).svg : "");
}
