// What all views share: elements, figures, ages, and values with their quality, in the language of the page. Texts reach the page as text nodes
// only, never as markup.

import { decimal, plain, t, unitOf, wordsOf as words } from "./texts.js";

export const $ = (id) => document.getElementById(id);

export function make(tag, className, ...children) {
  const element = document.createElement(tag);
  if (className) element.className = className;
  element.append(...children);
  return element;
}

/// A text of the gateway, which speaks English.
export function told(tag, className, ...children) {
  const element = make(tag, className, ...children);
  element.lang = "en";
  return element;
}

/// An element of SVG.
export function draw(tag, attributes = {}, ...children) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
}

export function anchor(href, className, ...children) {
  const element = make("a", className, ...children);
  element.setAttribute("href", href);
  return element;
}

/// A heading with an id of its own, and the section that it names.
export function section(id, title, ...children) {
  const heading = make("h2", "", title);
  heading.id = `${id}-title`;
  const element = make("section", "", heading, ...children);
  element.setAttribute("aria-labelledby", heading.id);
  return element;
}

// Updates only what changed, so that selections, focus and screen readers are not disturbed. What was set last is kept beside the
// element: asking the document for it is most of what an update of a thousand rows would cost.
export function text(element, value) {
  if (element.lastText === value) return;
  element.lastText = value;
  element.textContent = value;
}

export function className(element, value) {
  if (element.lastClass === value) return;
  element.lastClass = value;
  element.className = value;
}

export function hide(element, hidden) {
  if (element.lastHidden === hidden) return;
  element.lastHidden = hidden;
  element.hidden = hidden;
}

export function hint(element, value) {
  if ((element.lastTitle ?? "") === value) return;
  element.lastTitle = value;
  element.title = value;
}

/// The width of a bar, a share of 0 to 1.
export function fill(element, share) {
  const width = `${Math.min(100, Math.abs(share) * 100).toFixed(1)}%`;
  if (element.lastWidth === width) return;
  element.lastWidth = width;
  element.style.width = width;
}


export { words };

/// Links within the page.
export const places = {
  drive: (name) => `#/drive/${encodeURIComponent(name)}`,
  line: (name) => `#/line/${encodeURIComponent(name)}`,
  recording: (id) => `#/recording/${encodeURIComponent(id)}`,
};

const TITLES = { actual_speed: t("Speed"), output_frequency: t("Frequency"), motor_speed: t("Motor speed"), motor_current: t("Current"), motor_torque: t("Torque"),
  motor_power: t("Power"), motor_voltage: t("Voltage"), dc_link_voltage: t("DC link"), heatsink_temperature: t("Heatsink") };

/// The heading of a point: short for those that are on every page.
export const titleOf = (point) => TITLES[point] ?? words(point);

const DECIMALS = { "Hz": 2, "%": 1, "A": 1, "V": 0, "rpm": 0, "°C": 0, "kWh": 0, "h": 0 };

/// Digits after the point of a plot's figures.
export const digitsOf = (unit) => DECIMALS[unit] ?? 0;

export function figure(value, unit) {
  if (value === true) return t("yes");
  if (value === false) return t("no");
  if (typeof value !== "number") return String(value);
  const decimals = DECIMALS[unit];
  if (decimals === undefined) return plain(Math.round(value * 1000) / 1000);
  return decimal(value, decimals);
}

export function age(ms) {
  if (ms === null || ms === undefined) return t("never read");
  if (ms < 1000) return `${Math.round(ms)} ms`;
  if (ms < 60000) return `${decimal(ms / 1000, 1)} s`;
  if (ms < 3600000) return `${Math.floor(ms / 60000)} min`;
  return `${Math.floor(ms / 3600000)} h`;
}

/// A duration in seconds, as hours and minutes.
export function hours(seconds) {
  if (seconds < 60) return `${Math.floor(seconds)} s`;
  const minutes = Math.floor(seconds / 60);
  return minutes < 60 ? `${minutes} min` : `${Math.floor(minutes / 60)} h ${minutes % 60} min`;
}

const two = (n) => String(n).padStart(2, "0");

/// Time of day, with the date unless it is today's.
export function clock(time) {
  const today = new Date().toDateString() === time.toDateString();
  const day = today ? "" : `${time.getFullYear()}-${two(time.getMonth() + 1)}-${two(time.getDate())} `;
  return `${day}${two(time.getHours())}:${two(time.getMinutes())}:${two(time.getSeconds())}`;
}

export function stamp(time) {
  const element = make("time", "", clock(time));
  element.dateTime = time.toISOString();
  return element;
}

/// Bytes, for people.
export const size = (bytes) => (bytes < 1e6 ? `${Math.ceil(bytes / 1000)} kB` : `${decimal(bytes / 1e6, 1)} MB`);

// ---- States and qualities

/// Colour and sign of each state; faults are told first.
// Colour means that a person is wanted; what is as usual is grey.
export const STATES = { fault: ["red", "▲"], unknown: ["amber", "?"], offline: ["amber", "✕"], not_ready: ["", "◌"], ready: ["", "●"], running: ["runs", "▶"] };

export const stateWords = (state) => `${STATES[state]?.[1] ?? ""} ${words(state)}`.trim();

export const stateOf = (drive) => drive.state || "unknown";

const isGood = (point) => point !== undefined && point.quality === "good";

export const isOn = (point) => isGood(point) && Boolean(point.value);

export function badge(element, state) {
  className(element, `badge ${STATES[state]?.[0] ?? ""}`);
  text(element, stateWords(state));
}

export const faultWithoutText = (code) => t("fault {code} (no text known for this drive)", { code });

/// Code and text of the fault that is known for now; empty without one.
export function faultOf(drive) {
  const code = drive.points.fault_code;
  if (!isOn(code)) return "";
  return drive.fault_text === String(code.value) ? faultWithoutText(code.value) : `F${code.value} ${drive.fault_text}`;
}

const QUALITY_TITLES = {
  stale: (point) => old(point.age_ms, "stale"),
  bad: () => t("bad: refused by the drive or never read"),
  contradicted: (point) => t("read {age} ago; a newer state says otherwise", { age: age(point.age_ms) }),
};

const qualityOf = (point) => (!point ? "absent" : point.contradicted ? "contradicted" : point.quality);

/// The quality of something that is too old, with its age.
export function old(ms, quality) {
  if (ms === null || ms === undefined) return t("never read");
  return quality ? t("{quality}, {age} old", { quality: words(quality), age: age(ms) }) : t("{age} old", { age: age(ms) });
}

/// What is said beside a value about its age and quality: nothing of one that is as good and as new as it should be.
export function noteOf(point) {
  const quality = qualityOf(point);
  if (quality === "good") return "";
  if (quality === "bad") return t("bad");
  return quality === "contradicted" ? t("{age} old, contradicted since", { age: age(point.age_ms) }) : old(point.age_ms, quality);
}

/// A place for a value with its unit and, where it matters, its own age.
export function valueCell(tag, name) {
  const cell = { value: make("span", "value"), unit: make("span", "unit"), age: make("span", "sub age") };
  cell.element = make(tag, name, cell.value, cell.unit, cell.age);
  return cell;
}

// Values with a direction. Some families give them a sign, others only a bit: the page shows all of them as a magnitude and an arrow.
const DIRECTED = new Set(["actual_speed", "output_frequency", "motor_speed", "speed_reference", "frequency_reference", "reference"]);

export const isDirected = (name) => DIRECTED.has(name);

const magnitudeOf = (name, point) => (isDirected(name) && typeof point.value === "number" ? Math.abs(point.value) : point.value);

/// `cell.point` is the name of the point. `told`: the quality that is told of all its values together, which is not repeated.
export function showValue(cell, point, told) {
  const shown = Boolean(point) && point.value !== null;
  const quality = qualityOf(point);
  text(cell.value, shown ? (point.text ?? figure(magnitudeOf(cell.point, point), point.unit)) : point ? "—" : "");
  text(cell.unit, shown && point.unit && !point.text ? ` ${unitOf(point.unit)}` : "");
  className(cell.value, `value ${quality === "good" ? "main" : quality}`);
  hint(cell.value, point && QUALITY_TITLES[quality] ? QUALITY_TITLES[quality](point) : "");
  text(cell.age, shown && quality !== told ? noteOf(point) : "");
}

/// The share of the speed range, and the reference beside it. A value that is not good has no bar.
export function speedBar() {
  const bar = { fill: make("i"), direction: make("span", "sub direction"), reference: make("span", "sub") };
  bar.element = make("span", "bar", bar.fill);
  return bar;
}

export function fillSpeed(bar, point) {
  hide(bar.element, !point);
  fill(bar.fill, isGood(point) && !point.contradicted ? point.value / 100 : 0);
}

export function showSpeed(bar, point, points) {
  fillSpeed(bar, point);
  text(bar.direction, directionOf(points, point));
  const reference = points.speed_reference;
  const sign = reference?.value < 0 ? " ←" : "";
  text(bar.reference, isGood(reference) ? t("set {value}", { value: `${figure(Math.abs(reference.value), reference.unit)} %${sign}` }) : "");
}

/// The direction in words.
export const directionWord = (isReverse) => (isReverse ? t("reverse") : t("forward"));

/// The way that a drive turns, or would, with an arrow; empty where it is not known. A value below zero says it, whatever the bit says.
export function directionOf({ reversed }, point) {
  const isNegative = point?.value < 0;
  if (!isNegative && (!isGood(reversed) || reversed.contradicted)) return "";
  const isReverse = isNegative || Boolean(reversed.value);
  return `${isReverse ? "←" : "→"} ${directionWord(isReverse)}`;
}

/// The direction as an arrow behind the unit; its word is for readers of the screen.
export function markDirection(cell) {
  cell.direction = make("span", "direction", make("span", "arrow"), make("span", "unseen"));
  cell.unit.after(cell.direction);
}

/// The bit says how the motor turns; a reference has only its own sign.
export function showDirection({ point: name, direction: { children: [arrow, word] } }, point, points) {
  const known = name.endsWith("reference") && !(point?.value < 0) ? "" : directionOf(points, point);
  const [sign, ...rest] = (point ? known : "").split(" ");
  text(arrow, sign && ` ${sign}`);
  text(word, rest.length ? ` ${rest.join(" ")}` : "");
}

// ---- Lists

/// Keeps one entry for each item, by name; an entry has an `element`.
export function keyed(map, items, create, show) {
  const names = new Set(items.map((item) => item.name));
  for (const [name, entry] of map) {
    if (names.has(name)) continue;
    entry.element.remove();
    map.delete(name);
  }
  for (const item of items) {
    let entry = map.get(item.name);
    if (!entry) map.set(item.name, (entry = create(item)));
    show(entry, item);
  }
}

/// Brings the children of `parent` into this order with few moves. The focus stays where it is.
export function arrange(parent, wanted) {
  const focused = document.activeElement;
  let place = parent.firstElementChild;
  let moved = false;
  for (const element of wanted) {
    if (element === place) {
      place = place.nextElementSibling;
    } else if (place && place.nextElementSibling === element) {
      // What stood here belongs further down and is put there in its turn.
      place = element.nextElementSibling;
    } else {
      parent.insertBefore(element, place);
      moved = true;
    }
  }
  if (moved && focused && focused !== document.activeElement && parent.contains(focused)) focused.focus({ preventScroll: true });
}

/// Fills the body of a table with a row for each record. Rows that stay are not made anew: somebody may be on one of their links.
export function fillRows(entries, body, records, row) {
  const counts = new Map();
  const named = records.map((record) => {
    const content = JSON.stringify(record);
    counts.set(content, (counts.get(content) ?? 0) + 1);
    return { record, name: `${content} ${counts.get(content)}` };
  });
  keyed(entries, named, ({ record }) => ({ element: row(record) }), () => {});
  arrange(body, named.map(({ name }) => entries.get(name).element));
}

/// A row that opens that place from anywhere in it; its link is for keys and for readers of the screen.
export function opening(row, href) {
  row.classList.add("opening");
  row.addEventListener("click", ({ target }) => {
    if (!target.closest("a") && !getSelection().toString()) location.hash = href;
  });
  return row;
}

/// A table with headings, that can be scrolled by itself where it is wider than the page.
export function table(caption, ...headings) {
  const body = make("tbody");
  const head = make("tr", "", ...headings.map((heading) => {
    const cell = make("th", "", heading);
    cell.scope = "col";
    return cell;
  }));
  const element = make("div", "wide", make("table", "list", make("caption", "unseen", caption), make("thead", "", head), body));
  element.tabIndex = 0;
  element.setAttribute("role", "group");
  element.setAttribute("aria-label", caption);
  return { element, body };
}
