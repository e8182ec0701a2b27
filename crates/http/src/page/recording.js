// A recording: what was read before and after a fault as plots with one cursor, states as lanes, events, commands and frames under
// them. And the list of all recordings.

import { anchor, digitsOf, draw, fillRows, hide, make, opening, places, section, size, stamp, table, text, titleOf, told, words } from "./common.js";
import { EVENT_COLOURS, textOf } from "./events.js";
import { PlotGroup, reachOf, sampleAt, withGaps } from "./plot.js";
import { decimal, t } from "./texts.js";

const SECOND = 1000;
const FETCH_MS = 60000;
const FRAMES_SHOWN = 12;
// Events are noted a moment after the sample that shows them.
const SAME_MOMENT = 0.005;
const FIRST = ["actual_speed", "output_frequency", "motor_current", "motor_torque", "dc_link_voltage", "motor_voltage", "heatsink_temperature"];
const PLOTS_OPEN = 6;
// A read that failed leaves a gap: nothing is drawn over more than this many of the usual intervals.
const GAP_INTERVALS = 4;

const seconds = (time) => `${time < 0 ? "−" : "+"}${decimal(Math.abs(time), 3)} s`;

// ---- Pure: what there is to draw

/// What was read of each point, oldest first: t in ms from the trigger.
export function columns(recording) {
  const all = new Map(recording.points.map(({ name, unit }) => [name, { name, unit, samples: [] }]));
  for (const { t, points } of recording.samples) {
    for (const [name, value] of Object.entries(points)) all.get(name)?.samples.push({ t: t * SECOND, value });
  }
  return [...all.values()].filter((column) => column.samples.length > 0);
}

/// Samples as a plot takes them: `null` where nothing was read for long, or the value is none.
export function curve(samples) {
  const drawn = samples.map(({ t, value }) => (typeof value === "number" ? { t, low: value, high: value, value } : { t, none: true }));
  return withGaps(drawn, GAP_INTERVALS);
}

/// The times during which a state was on, from and to.
export function spans(samples, end) {
  const all = [];
  const reach = reachOf(samples, GAP_INTERVALS);
  samples.forEach(({ t, value }, place) => {
    const next = samples[place + 1]?.t ?? end;
    const until = Math.min(next, t + reach);
    const last = all[all.length - 1];
    if (value !== true) return;
    if (last && last.to >= t) last.to = until;
    else all.push({ from: t, to: until });
  });
  return all;
}

/// Everything that has a moment, in its order.
export function happenings(recording) {
  const { name } = recording.drive;
  const events = recording.events.map((event) => ({ t: event.t, kind: words(event.event), colour: EVENT_COLOURS[event.event] || "", text: textOf({ text: event.text, drive: name }) }));
  const commands = recording.commands.map((command) => ({ t: command.t, kind: t("command"), colour: "",
    text: t("{command} from {client}: {result} after {time}", { command: command.command, client: `${words(command.source)} ${command.client}`, result: words(command.result), time: `${decimal(command.latency_ms, 0)} ms` }) }));
  const more = recording.more.map(({ t, trigger, text: what }) => ({ t, kind: words(trigger), colour: "amber", text: what }));
  return [...events, ...commands, ...more].sort((a, b) => a.t - b.t);
}

// ---- Lanes of states

/// States that changed, each a lane of the time it was on.
function lanes(group, states) {
  const element = make("div", "lanes");
  const entries = states.map((column) => {
    const svg = draw("svg", { role: "img", "aria-label": words(column.name), height: 16, preserveAspectRatio: "none" });
    const value = make("span", "reading");
    element.append(make("div", "lane", make("span", "label", words(column.name)), svg, value));
    return { column, svg, value };
  });
  group.listeners.push((at) => {
    for (const { column, value } of entries) text(value, { true: t("on"), false: t("off") }[sampleAt(column.samples, at, Infinity)?.value] ?? "?");
  });
  group.drawers.push(() => {
    const { from, to } = group.range;
    for (const { column, svg } of entries) {
      svg.setAttribute("viewBox", `0 0 1000 16`);
      const on = spans(column.samples, to);
      const x = (t) => (1000 * (t - from)) / (to - from);
      svg.replaceChildren(draw("line", { class: "grid", x1: 0, x2: 1000, y1: 15, y2: 15 }),
        ...on.map((span) => draw("rect", { class: `on ${column.name}`, x: x(span.from), y: 2, width: Math.max(1, x(span.to) - x(span.from)), height: 13 })));
      const told = on.map((span) => t("{from} to {to}", { from: seconds(span.from / SECOND), to: seconds(span.to / SECOND) }));
      const times = told.length === 0 ? t("never on") : told.length > 4 ? t("on {count} times", { count: told.length }) : t("on {times}", { times: told.join(", ") });
      svg.setAttribute("aria-label", `${words(column.name)}: ${times}`);
    }
  });
  return element;
}

// ---- Frames

/// As `drivegate trace` says it: the gateway decodes, and what is as usual needs no verdict.
const meaningOf = ({ decode, verdict }) => [decode, ["sent", "ok"].includes(verdict) || decode.startsWith(verdict) ? "" : verdict].filter(Boolean).join(", ");

function frameList(recording) {
  const list = table(t("Frames on the line around the cursor"), "t", t("Drive"), t("What"), t("Bytes"));
  let first = null;
  return {
    element: list.element,
    /// Those around `t`, s.
    show(t) {
      const after = recording.frames.findIndex((frame) => frame.t > t);
      const middle = after < 0 ? recording.frames.length : after;
      const begin = Math.max(0, Math.min(middle - FRAMES_SHOWN / 2, recording.frames.length - FRAMES_SHOWN));
      if (begin !== first) {
        first = begin;
        list.body.replaceChildren(...recording.frames.slice(begin, begin + FRAMES_SHOWN).map((frame) => {
          const row = make("tr", "", make("td", "", seconds(frame.t)), make("td", "", recording.bus.drives[frame.drive] ?? ""), told("td", "", meaningOf(frame)),
            make("td", "hex", frame.hex.replace(/(..)(?=.)/g, "$1 ")));
          row.dataset.t = frame.t;
          return row;
        }));
      }
      for (const row of list.body.children) row.classList.toggle("past", Number(row.dataset.t) <= t);
    },
  };
}

// ---- The view

function show(root, recording) {
  const from = recording.from * SECOND;
  const to = recording.to * SECOND;
  const time = new Date(recording.time);
  const all = columns(recording);
  const numbers = all.filter((column) => column.samples.some((sample) => typeof sample.value === "number") && column.samples.length > 2);
  const states = all.filter((column) => new Set(column.samples.map((sample) => sample.value).filter((value) => typeof value === "boolean")).size > 1);
  const group = new PlotGroup({ name: t("Cursor of the recording"), height: 124, relative: true, rests: false,
    moment: (at) => seconds(at / SECOND), label: (at, step) => `${at > 0.0001 ? "+" : ""}${decimal(at / SECOND, step < SECOND ? 1 : 0)} s` });
  const known = FIRST.map((name) => numbers.find((column) => column.name === name)).filter(Boolean).slice(0, PLOTS_OPEN);
  const things = happenings(recording);
  const marks = [{ t: 0, colour: "red", text: recording.summary }, ...things.filter((thing) => Math.abs(thing.t) > 0.001).map((thing) => ({ t: thing.t * SECOND, colour: thing.colour, text: `${thing.kind}: ${thing.text}` }))];
  const addPlot = (column) => {
    const { samples, reach } = curve(column.samples);
    group.add({ title: titleOf(column.name), unit: column.unit, digits: digitsOf(column.unit) }).show(samples, { reach, marks });
  };
  root.replaceChildren(...head(recording, time));
  const rest = numbers.filter((column) => !known.includes(column));
  const plots = section("plots", t("Values read"), zoom(group, from, to), group.element, choice(rest, addPlot));
  group.grid.before(lanes(group, states));
  const frames = frameList(recording);
  const happened = thingList(things, (time) => group.point(time * SECOND));
  root.append(plots, section("happened", t("What happened"), happened.element), section("frames", t("Frames on the line"), frames.element,
    make("p", "note", t("{count} frames", { count: recording.frames.length }), " · ", files(recording.id, ["pcap"]))));
  known.forEach(addPlot);
  group.setRange(from, to, 1);
  group.listeners.push((at) => {
    frames.show(at / SECOND);
    happened.mark(at / SECOND);
  });
  group.point(0);
}

function head(recording, time) {
  const { drive, bus } = recording;
  const where = make("p", "where", anchor(places.drive(drive.name), "", drive.name), ` · ${drive.profile} · ${t("address {address}", drive)} · `, anchor(places.line(bus.name), "", bus.name),
    ` · ${bus.protocol} ${bus.format} · `, stamp(time), ` · ${t("{from} to {to}", { from: seconds(recording.from), to: seconds(recording.to) })}`);
  const downloads = make("p", "files", `${t("Download:")} `, files(recording.id, ["csv", "pcap", "json"]));
  const lost = make("p", "note problem", t("{count} entries could not be recorded in time.", { count: recording.lost }));
  hide(lost, recording.lost === 0);
  return [make("p", "crumbs", anchor("#/recordings", "", t("Recordings")), " › "), make("h1", "", t("Recording: {trigger} of {drive}", { trigger: words(recording.trigger), drive: drive.name })), where,
    told("p", "why summary", recording.summary), downloads, lost];
}

const FILES = { csv: [t("CSV of the values"), ".csv"], pcap: [t("pcap of the frames, for Wireshark"), ".pcapng"], json: [t("JSON of everything"), ".json"] };

/// Links to the files of a recording.
function files(id, formats) {
  const links = formats.map((format) => {
    const link = anchor(`api/v1/recordings/${encodeURIComponent(id)}?format=${format}`, "", FILES[format][0]);
    link.download = `${id}${FILES[format][1]}`;
    return link;
  });
  return make("span", "", ...links.flatMap((link, place) => (place ? [" ", link] : [link])));
}

/// Buttons that show the time around the cursor.
function zoom(group, from, to) {
  const element = make("div", "choices");
  element.setAttribute("role", "group");
  element.setAttribute("aria-label", t("Time shown around the cursor"));
  for (const [title, span] of [[t("all"), Infinity], ["10 s", 10 * SECOND], ["2 s", 2 * SECOND], [`${decimal(0.5, 1)} s`, SECOND / 2]]) {
    const button = make("button", "chip", title);
    button.type = "button";
    button.setAttribute("aria-pressed", String(span === Infinity));
    button.addEventListener("click", () => {
      const begin = Math.max(from, Math.min(group.cursor - span / 2, to - span));
      group.setRange(begin, Math.min(to, begin + span), 1);
      for (const each of element.children) each.setAttribute("aria-pressed", String(each === button));
    });
    element.append(button);
  }
  return element;
}

/// Plots of the points that are not shown at once.
function choice(rest, add) {
  const select = make("select");
  select.id = "more-points";
  select.append(make("option", "", t("choose …")), ...rest.map((column, place) => {
    const option = make("option", "", words(column.name));
    option.value = String(place);
    return option;
  }));
  select.addEventListener("change", () => {
    const option = select.selectedOptions[0];
    const column = rest[Number(option.value)];
    if (!column) return;
    add(column);
    option.disabled = true;
    select.selectedIndex = 0;
  });
  const label = make("label", "", `${t("Another point")} `);
  label.htmlFor = select.id;
  const element = make("p", "field", label, select);
  hide(element, rest.length === 0);
  return element;
}

/// Events and commands; each puts the cursor to its moment.
function thingList(things, go) {
  const list = make("ol", "events happenings");
  const items = things.map((thing) => {
    const button = make("button", "moment", seconds(thing.t));
    button.type = "button";
    button.addEventListener("click", () => go(thing.t));
    return make("li", "", button, make("span", `tag ${thing.colour}`, thing.kind), make("span", "text", thing.text));
  });
  list.append(...items);
  const element = things.length ? list : make("p", "note", t("No events or commands."));
  return { element, mark: (time) => items.forEach((item, place) => item.classList.toggle("past", things[place].t <= time + SAME_MOMENT)) };
}

/// One recording. It never changes, so it is fetched once, however long that takes; whether the gateway answers is asked besides.
export function open(root, { name }) {
  root.append(make("h1", "", t("Recording")), make("p", "note", t("Loading …")));
  let fetched = null;
  let shown = false;
  return {
    title: t("Recording {id}", { id: name }),
    async refresh(load) {
      fetched ??= load(`recordings/${encodeURIComponent(name)}`, FETCH_MS).then((recording) => ({ recording }), (error) => ({ error }));
      await load("buses");
      const { recording, error } = shown ? {} : await Promise.race([fetched, Promise.resolve({})]);
      if (error) {
        fetched = null;
        throw error;
      }
      if (!recording) return;
      shown = true;
      show(root, recording);
    },
  };
}

/// All recordings, newest first.
export function openList(root) {
  const list = table(t("Recordings"), t("Time"), t("Drive"), t("Trigger"), t("Summary"), t("Size"));
  const note = make("p", "note", t("There are no recordings. The gateway makes one when a drive trips, is lost, or refuses a stop."));
  root.append(make("h1", "", t("Recordings")), list.element, note);
  const entries = new Map();
  const row = (record) => opening(make("tr", "", make("td", "", stamp(new Date(record.time))), make("td", "", anchor(places.drive(record.drive), "", record.drive)),
    make("td", "", anchor(places.recording(record.id), "", words(record.trigger))), told("td", "", record.summary), make("td", "n", size(record.bytes))), places.recording(record.id));
  return {
    title: t("Recordings"),
    async refresh(load) {
      const records = (await load("recordings")).reverse();
      hide(note, records.length > 0);
      hide(list.element, records.length === 0);
      fillRows(entries, list.body, records, row);
    },
  };
}
