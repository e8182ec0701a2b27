"use strict";
// Shows the JSON interface live. Texts reach the page as text nodes only, never as markup.

const PERIOD_MS = 1000;
const LOST_MS = 3500;
const FETCH_MS = 4000;
const EVENTS_SHOWN = 100;
const OLDER_MS = 500;

const $ = (id) => document.getElementById(id);

function make(tag, className, ...children) {
  const element = document.createElement(tag);
  if (className) element.className = className;
  element.append(...children);
  return element;
}

// Updates only what changed, so that selections, focus and screen readers are not disturbed.
function text(element, value) {
  if (element.textContent !== value) element.textContent = value;
}

function className(element, value) {
  if (element.className !== value) element.className = value;
}

const DECIMALS = { "Hz": 2, "%": 1, "A": 1, "V": 0, "rpm": 0, "°C": 0, "kWh": 0, "h": 0 };

function figure(value, unit) {
  if (value === true) return "yes";
  if (value === false) return "no";
  const decimals = DECIMALS[unit];
  if (decimals === undefined) return String(Math.round(value * 1000) / 1000);
  return value.toFixed(decimals);
}

function age(ms) {
  if (ms === null || ms === undefined) return "never read";
  if (ms < 1000) return `${ms} ms`;
  if (ms < 60000) return `${(ms / 1000).toFixed(1)} s`;
  if (ms < 3600000) return `${Math.floor(ms / 60000)} min`;
  return `${Math.floor(ms / 3600000)} h`;
}

function clock(time) {
  const pad = (n) => String(n).padStart(2, "0");
  const today = new Date().toDateString() === time.toDateString();
  const day = today ? "" : `${time.getFullYear()}-${pad(time.getMonth() + 1)}-${pad(time.getDate())} `;
  return `${day}${pad(time.getHours())}:${pad(time.getMinutes())}:${pad(time.getSeconds())}`;
}

// ---- Drives

const STATES = {
  running: ["green", "▶ running"],
  ready: ["blue", "● ready"],
  not_ready: ["amber", "◌ not ready"],
  fault: ["red", "▲ fault"],
  offline: ["", "✕ offline"],
  unknown: ["amber", "? unknown"],
};

const COLUMNS = [
  ["Speed", "actual_speed"], ["Frequency", "output_frequency"], ["Motor", "motor_speed"],
  ["Current", "motor_current"], ["Torque", "motor_torque"], ["Power", "motor_power"],
  ["DC link", "dc_link_voltage"], ["Heatsink", "heatsink_temperature"],
];

const rows = new Map();

// `newest` is the age of the process data: a good value that is much older shows its own.
function valueInto(span, unitSpan, point, ageSpan, newest) {
  const shown = point && point.value !== null;
  const quality = !point ? "absent" : point.contradicted ? "contradicted" : point.quality;
  text(span, shown ? (point.text ?? figure(point.value, point.unit)) : point ? "—" : "");
  text(unitSpan, shown && point.unit && !point.text ? ` ${point.unit}` : "");
  className(span, `value ${quality === "good" ? "main" : quality}`);
  const title = {
    stale: `stale, ${age(point && point.age_ms)} old`, bad: "bad: refused by the drive or never read",
    contradicted: `read ${age(point && point.age_ms)} ago; a newer state says otherwise`,
  }[quality];
  if (title) span.title = title; else span.removeAttribute("title");
  if (!ageSpan) return;
  const older = shown && point.age_ms !== null && (newest === null || point.age_ms > newest + OLDER_MS);
  text(ageSpan, older ? `${age(point.age_ms)} old` : "");
}

function driveRow(name) {
  const row = { open: make("button", "open", name), where: make("span", "where"), badge: make("span", "badge"),
    warning: make("span", "tag amber", "warning"), why: make("span", "why"), blocked: make("span", "sub blocked"), causes: make("ul", "causes"), cells: [], points: new Map() };
  row.open.type = "button";
  row.open.setAttribute("aria-expanded", "false");
  const first = make("td", "", row.open, make("br"), row.where);
  const state = make("td", "", row.badge, " ", row.warning, row.why, row.blocked);
  const tr = make("tr", "main-row", first, state);
  for (const [title, point] of COLUMNS) {
    const cell = { point, value: make("span", "value"), unit: make("span", "unit"), age: make("span", "sub age"), extra: null };
    cell.td = make("td", "n", cell.value, cell.unit, cell.age);
    cell.td.dataset.title = title;
    if (point === "actual_speed") {
      cell.extra = { fill: make("i"), reference: make("span", "sub") };
      cell.td.append(make("span", "bar", cell.extra.fill), cell.extra.reference);
    }
    row.cells.push(cell);
    tr.append(cell.td);
  }
  row.age = make("span", "value");
  row.quality = make("span", "tag");
  const last = make("td", "n", row.age, " ", row.quality);
  last.dataset.title = "Age";
  tr.append(last);
  row.list = make("dl", "points");
  const detail = make("td", "", row.causes, row.list);
  detail.colSpan = COLUMNS.length + 3;
  row.detail = make("tr", "detail", detail);
  row.detail.hidden = true;
  row.body = make("tbody", "", tr, row.detail);
  operateRow(row, name, tr);
  row.open.addEventListener("click", () => {
    row.detail.hidden = !row.detail.hidden;
    row.open.setAttribute("aria-expanded", String(!row.detail.hidden));
    if (row.drive) showPoints(row, row.drive);
  });
  $("drives").append(row.body);
  return row;
}

// The controls of a drive, where the gateway serves them.
function operateRow(row, name, before) {
  if (typeof Operate === "undefined") return;
  const place = make("div");
  place.dataset.operate = name;
  const cell = make("td", "", place);
  cell.colSpan = COLUMNS.length + 3;
  before.after(make("tr", "operate-row", cell));
  Operate.mount(place, name);
}

function showDrive(row, drive) {
  row.drive = drive;
  if (typeof Operate !== "undefined") Operate.update(drive);
  const state = drive.state || "unknown";
  const [colour, word] = STATES[state] || ["", state];
  className(row.body, state);
  className(row.badge, `badge ${colour}`);
  text(row.badge, word);
  const warning = drive.points.warning;
  row.warning.hidden = !(warning && warning.quality === "good" && warning.value);
  const code = drive.points.fault_code;
  const known = code && code.quality === "good" && code.value;
  const fault = !known ? "" : drive.fault_text === String(code.value) ? `fault ${code.value}` : `F${code.value} ${drive.fault_text}`;
  text(row.why, fault);
  row.why.hidden = !fault;
  // The fault and a drive that is offline have their own words above.
  const words = drive.blocked_by.filter((word) => word !== "fault" && word !== "offline").map((word) => word.replaceAll("_", " "));
  text(row.blocked, words.join(", "));
  row.blocked.hidden = words.length === 0;
  text(row.where, `${drive.bus} · address ${drive.address} · ${drive.profile}`);
  for (const cell of row.cells) {
    const point = drive.points[cell.point];
    valueInto(cell.value, cell.unit, point, cell.age, drive.age_ms);
    cell.td.classList.toggle("absent", !point);
    if (cell.extra) showSpeed(cell.extra, point, drive.points.speed_reference);
  }
  text(row.age, age(drive.age_ms));
  className(row.age, `value ${drive.quality === "good" ? "" : drive.quality}`);
  text(row.quality, drive.quality);
  className(row.quality, `tag ${drive.quality === "stale" ? "amber" : "red"}`);
  row.quality.hidden = drive.quality === "good" || drive.age_ms === null;
  if (!row.detail.hidden) showPoints(row, drive);
}

function showSpeed(extra, point, reference) {
  const good = point && point.quality === "good";
  extra.fill.parentElement.hidden = !good;
  extra.fill.style.width = good ? `${Math.min(100, Math.abs(point.value))}%` : "0";
  const known = reference && reference.quality === "good";
  text(extra.reference, known ? `set ${figure(reference.value, reference.unit)} %` : "");
}

function showPoints(row, drive) {
  const causes = drive.why.map((cause) => {
    const since = cause.age_ms === null || cause.age_ms === undefined ? "" : ` (${age(cause.age_ms)} ago)`;
    return `${cause.cause.replaceAll("_", " ")}: ${cause.evidence}${since}. What to do: ${cause.remedy}.`;
  });
  while (row.causes.children.length > causes.length) row.causes.lastChild.remove();
  while (row.causes.children.length < causes.length) row.causes.append(make("li"));
  causes.forEach((cause, place) => text(row.causes.children[place], cause));
  row.causes.hidden = causes.length === 0;
  // A reload may have given the drive another profile.
  for (const [name, entry] of row.points) {
    if (name in drive.points) continue;
    entry.element.remove();
    row.points.delete(name);
  }
  for (const [name, point] of Object.entries(drive.points)) {
    let entry = row.points.get(name);
    if (!entry) {
      entry = { value: make("span"), unit: make("span", "unit"), note: make("span", "sub") };
      entry.element = make("div", "", make("dt", "", name.replaceAll("_", " ")), make("dd", "", entry.value, entry.unit, entry.note));
      row.list.append(entry.element);
      row.points.set(name, entry);
    }
    valueInto(entry.value, entry.unit, point);
    text(entry.note, point.contradicted ? `${age(point.age_ms)}, contradicted since` : point.quality === "good" ? age(point.age_ms) : point.quality === "bad" ? "bad" : `stale, ${age(point.age_ms)}`);
  }
}

// ---- Buses

const cards = new Map();

function busCard(name) {
  const card = { badge: make("span", "badge"), where: make("p", "where"), why: make("p", "why"), fill: make("i"), values: {} };
  const list = make("dl");
  for (const title of ["Line load", "Fast cycle", "Slow cycle", "Exchanges", "Errors", "Waiting", "Drives online"]) {
    card.values[title] = make("dd", "value");
    list.append(make("dt", "", title), card.values[title]);
    if (title === "Line load") {
      const bar = make("dd", "span", make("span", "bar", card.fill));
      bar.style.gridColumn = "1 / -1";
      list.append(bar);
    }
  }
  card.element = make("article", "card", make("h3", "", name, card.badge), card.where, card.why, list);
  $("buses").append(card.element);
  return card;
}

function showBus(card, bus, now) {
  const up = bus.state === "up";
  text(card.badge, up ? "● up" : bus.tried ? "✕ down" : "◌ opening");
  className(card.badge, `badge ${up ? "green" : bus.tried ? "red" : "amber"}`);
  text(card.where, `${bus.port} · ${bus.protocol} · ${bus.baud} ${bus.format}`);
  text(card.why, bus.reason || "");
  card.why.hidden = !bus.reason;
  card.fill.style.width = `${Math.min(100, (bus.load_ratio ?? 0) * 100)}%`;
  text(card.values["Line load"], bus.load_ratio === null ? "—" : `${(bus.load_ratio * 100).toFixed(1)} %`);
  cycle(card.values["Fast cycle"], bus.fast, up);
  cycle(card.values["Slow cycle"], bus.slow, up);
  text(card.values["Exchanges"], rate(card, bus, now));
  const errors = bus.transactions ? ` (${(100 * bus.errors / bus.transactions).toFixed(2)} %)` : "";
  text(card.values["Errors"], `${bus.errors}${errors}`);
  text(card.values["Waiting"], String(bus.queue_depth));
  text(card.values["Drives online"], `${bus.online} of ${bus.drives}`);
}

function cycle(element, cadence, up) {
  const short = (ms) => (ms >= 1000 ? `${(ms / 1000).toFixed(2).replace(/\.?0+$/, "")} s` : `${Number(ms.toPrecision(3))} ms`);
  const known = up && cadence.cycle_ms !== null;
  text(element, known ? `${short(cadence.cycle_ms)} (aim ${short(cadence.aim_ms)})` : `— (aim ${short(cadence.aim_ms)})`);
  className(element, known && cadence.cycle_ms > 1.2 * cadence.aim_ms ? "value slow" : "value");
}

// Rate over the last seconds, from the counters.
function rate(card, bus, now) {
  card.history = (card.history || []).filter((h) => now - h.at < 5000 && h.count <= bus.transactions);
  const oldest = card.history[0];
  card.history.push({ at: now, count: bus.transactions });
  if (!oldest || now === oldest.at) return `${bus.transactions} in total`;
  return `${Math.round(1000 * (bus.transactions - oldest.count) / (now - oldest.at))} /s`;
}

// ---- Everything

function keyed(map, items, create, show, element) {
  const names = new Set(items.map((item) => item.name));
  for (const [name, entry] of map) {
    if (!names.has(name)) {
      entry[element].remove();
      map.delete(name);
    }
  }
  for (const item of items) {
    if (!map.has(item.name)) map.set(item.name, create(item.name));
    show(map.get(item.name), item);
  }
}

function tile(name, value, colour) {
  const element = document.querySelector(`[data-tile="${name}"]`);
  text(element, value);
  className(element.parentElement, colour);
}

function show(drives, buses) {
  const now = performance.now();
  keyed(rows, drives, driveRow, showDrive, "body");
  keyed(cards, buses, busCard, (card, bus) => showBus(card, bus, now), "element");
  const count = (test) => drives.filter(test).length;
  const warned = (d) => d.points.warning && d.points.warning.quality === "good" && d.points.warning.value;
  const online = count((d) => d.state !== "offline");
  const faults = count((d) => d.state === "fault");
  const warnings = count(warned);
  const up = buses.filter((b) => b.state === "up").length;
  tile("online", `${online} of ${drives.length}`, online < drives.length ? "amber" : "");
  tile("running", String(count((d) => d.state === "running")), "");
  tile("faults", String(faults), faults ? "red" : "");
  tile("warnings", String(warnings), warnings ? "amber" : "");
  tile("buses", `${up} of ${buses.length}`, up < buses.length ? "red" : "");
  $("live").hidden = false;
}

let lastGood = performance.now();
let lastGoodTime = null;
let lost = null;
let timer = null;
let asking = false;

function connected(good) {
  if (lost === !good) return;
  lost = !good;
  document.body.classList.toggle("lost", lost);
  className($("link"), `pill ${lost ? "red" : "green"}`);
  $("link").hidden = false;
  text($("link-text"), lost ? "Connection lost" : "Live");
  const since = lastGoodTime ? `since ${clock(lastGoodTime)}` : "yet";
  text($("banner"), lost ? `No connection to the gateway ${since}. The values below are old. Reconnecting…` : "");
  $("banner").hidden = !lost;
}

async function load(path, more = {}) {
  const headers = { Accept: "application/json", ...more };
  const reply = await fetch(path, { headers, cache: "no-store", signal: AbortSignal.timeout(FETCH_MS) });
  if (!reply.ok) throw new Error(`${path}: ${reply.status}`);
  return reply.json();
}

async function tick() {
  if (asking) return;
  asking = true;
  const started = performance.now();
  try {
    const [drives, buses, news] = await Promise.all([
      load("api/v1/drives"), load("api/v1/buses"), load("api/v1/events", { "Last-Event-ID": lastEvent }),
    ]);
    show(drives, buses);
    showEvents(news);
    lastGood = performance.now();
    lastGoodTime = new Date();
    connected(true);
  } catch (error) {
    console.warn("cannot read the gateway:", error);
  }
  asking = false;
  if (!document.hidden) timer = setTimeout(tick, Math.max(200, PERIOD_MS - (performance.now() - started)));
}

// ---- Events

const EVENT_COLOURS = { fault: "red", offline: "red", bus_down: "red", supervision: "amber", unsupervised: "amber", refused_command: "amber",
  restarted: "amber", unlike_profile: "amber", not_confirmed: "amber", reload_refused: "amber", fault_end: "green", online: "green", bus_up: "green" };
let lastEvent = "";

function addEvent(time, kind, subject, words) {
  const tag = make("span", `tag ${EVENT_COLOURS[kind] || ""}`, kind.replaceAll("_", " "));
  const stamp = make("time", "", clock(time));
  stamp.dateTime = time.toISOString();
  $("events").prepend(make("li", "", stamp, make("b", "", subject), tag, make("span", "text", words)));
  while ($("events").children.length > EVENTS_SHOWN) $("events").lastChild.remove();
}

// Polled like the rest instead of streamed: a browser has few connections to one server, and each
// open stream would occupy one.
function showEvents(news) {
  const anew = news.last.split("-")[0] !== lastEvent.split("-")[0];
  if (anew) $("events").replaceChildren();
  lastEvent = news.last;
  for (const event of news.events.slice(-EVENTS_SHOWN)) addEvent(new Date(event.time), event.event, event.drive || event.bus || "gateway", event.text);
  $("events-note").hidden = $("events").children.length > 0;
}

// A hidden page does not poll.
function visible() {
  clearTimeout(timer);
  if (document.hidden) return;
  lastGood = performance.now();
  tick();
}

document.addEventListener("visibilitychange", visible);
setInterval(() => {
  if (!document.hidden && performance.now() - lastGood > LOST_MS) connected(false);
}, 500);
visible();
