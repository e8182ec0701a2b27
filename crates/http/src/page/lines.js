// Lines: load, cycles against their target, exchanges; errors of each drive over the last hour; how fast the drives answer.

import { anchor, className, clock, fill, hide, keyed, make, places, section, stateOf, STATES, stateWords, table, text, told, words } from "./common.js";
import { Refused } from "./gateway.js";
import { brokerCards } from "./mqtt.js";
import { PlotGroup } from "./plot.js";
import { histogram, strip } from "./strips.js";
import { decimal, plain, t } from "./texts.js";

const RATE_MS = 5000;
const DIAGNOSIS_MS = 10000;
const TITLES = { load: t("Line load"), fast: t("Fast cycle"), slow: t("Slow cycle"), exchanges: t("Transactions"), errors: t("Errors"), waiting: t("Waiting"), online: t("Drives online") };
const FACTS = Object.keys(TITLES);
/// Those of a line among others.
export const FEW_FACTS = ["load", "fast", "errors"];

const short = (ms) => (ms >= 1000 ? `${plain(Math.round(ms / 10) / 100)} s` : `${plain(Number(ms.toPrecision(3)))} ms`);

function showCycle(element, cadence, up) {
  const known = up && cadence.cycle_ms !== null;
  const late = known && cadence.cycle_ms > 1.2 * cadence.aim_ms;
  const time = short(cadence.aim_ms);
  const target = late ? t("target {time}: too slow", { time }) : t("target {time}", { time });
  text(element, `${known ? short(cadence.cycle_ms) : "—"} (${target})`);
  className(element, late ? "value slow" : "value");
}

// Rate over the last seconds, from the counters.
function rate(facts, bus) {
  const now = performance.now();
  facts.history = (facts.history || []).filter((past) => now - past.at < RATE_MS && past.count <= bus.transactions);
  const oldest = facts.history[0];
  facts.history.push({ at: now, count: bus.transactions });
  if (!oldest || now === oldest.at) return t("{count} in total", { count: bus.transactions });
  return `${Math.round((1000 * (bus.transactions - oldest.count)) / (now - oldest.at))} /s`;
}

/// Figures of a line.
function busFacts(shown = FACTS) {
  const facts = { badge: make("span", "badge"), where: make("p", "where"), why: told("p", "why"), fill: make("i"), values: {} };
  facts.list = make("dl");
  for (const name of shown) {
    facts.values[name] = make("dd", "value");
    facts.list.append(make("div", "", make("dt", "", TITLES[name]), facts.values[name]));
  }
  facts.bar = make("span", "bar", facts.fill);
  return facts;
}

function showFacts(facts, bus) {
  const up = bus.state === "up";
  text(facts.badge, up ? `● ${t("up")}` : bus.tried ? `✕ ${t("down")}` : `◌ ${t("opening")}`);
  className(facts.badge, `badge ${up ? "" : bus.tried ? "red" : "amber"}`);
  text(facts.where, `${bus.port} · ${bus.protocol} · ${bus.baud} ${bus.format}`);
  text(facts.why, bus.reason || "");
  hide(facts.why, !bus.reason);
  const known = up && bus.load_ratio !== null;
  fill(facts.fill, known ? bus.load_ratio : 0);
  const set = (name, value) => facts.values[name] && text(facts.values[name], value);
  set("load", known ? `${decimal(bus.load_ratio * 100, 1)} %` : "—");
  showCycle(facts.values.fast, bus.fast, up);
  if (facts.values.slow) showCycle(facts.values.slow, bus.slow, up);
  set("exchanges", rate(facts, bus));
  const errors = bus.transactions ? ` (${decimal((100 * bus.errors) / bus.transactions, 2)} %)` : "";
  set("errors", `${bus.errors}${errors}`);
  set("waiting", String(bus.queue_depth));
  set("online", t("{shown} of {count}", { shown: bus.online, count: bus.drives }));
}

/// A card for each line, with a heading of that level; the states of its drives in words. `address`: of the drives of a line; `titles`: its
/// figures.
export function busCards(level, address, titles) {
  const cards = new Map();
  const element = make("div", "cards");
  const create = ({ name }) => {
    const card = { facts: busFacts(titles), states: make("a", "states") };
    card.states.setAttribute("href", address(name));
    card.element = make("article", "card", make(level, "", anchor(places.line(name), "", name), card.facts.badge), card.facts.where, card.facts.why,
      make("p", "tally", card.states), card.facts.bar, card.facts.list);
    element.append(card.element);
    return card;
  };
  return {
    element,
    show(buses, drives) {
      const counts = new Map();
      for (const drive of drives) {
        const own = counts.get(drive.bus) ?? counts.set(drive.bus, new Map()).get(drive.bus);
        own.set(stateOf(drive), (own.get(stateOf(drive)) ?? 0) + 1);
      }
      keyed(cards, buses, create, (card, bus) => {
        showFacts(card.facts, bus);
        const own = counts.get(bus.name) ?? new Map();
        const told = Object.keys(STATES).filter((state) => own.has(state));
        text(card.states, told.map((state) => `${STATES[state][1]} ${own.get(state)} ${words(state)}`.replaceAll(" ", "\u00a0")).join(" · ") || t("no drives"));
      });
    },
  };
}

/// All lines.
export function open(root) {
  const cards = busCards("h2", (bus) => `#/?bus=${encodeURIComponent(bus)}`);
  const brokers = brokerCards("h2");
  root.append(make("h1", "", t("Lines")), cards.element, brokers.element);
  return {
    title: t("Lines"),
    async refresh(load) {
      const [buses, drives, mqtt] = await Promise.all([load("buses"), load("drives?points="), load("mqtt")]);
      cards.show(buses, drives);
      brokers.show(mqtt);
    },
  };
}

// What the gateway has not or may not tell is left out.
async function optional(reply) {
  try {
    return await reply;
  } catch (error) {
    if (error instanceof Refused) return null;
    throw error;
  }
}

/// What the gateway found wrong with the line, with what shows it and what to do.
function diagnosisPanel() {
  const list = make("ul", "causes");
  const note = make("p", "note");
  const element = section("diagnosis", t("Diagnosis"), list, note);
  element.classList.add("panel", "why-panel");
  const item = ({ verdict, drive, certainty, meaning, evidence, remedy }) => {
    const about = drive ? [" ", anchor(places.drive(drive), "", drive)] : [];
    return make("li", "", make("b", "", words(verdict), ...about), told("span", "evidence", `${meaning} (${words(certainty)}): ${evidence}`), told("span", "remedy", remedy));
  };
  return {
    element,
    /// `null` where the gateway makes none.
    show(found) {
      hide(element, found === null);
      const state = JSON.stringify(found?.verdicts ?? []);
      text(note, found?.verdicts.length ? "" : found?.time ? t("No problems detected on this line.") : t("Not available yet."));
      if (state === element.state) return;
      element.state = state;
      element.classList.toggle("quiet", !found?.verdicts.length);
      list.replaceChildren(...(found?.verdicts ?? []).map(item));
    },
  };
}

/// The row of a drive in the table of its line.
function memberRow(body) {
  return ({ name }) => {
    const row = { state: make("td"), total: make("td", "n"), errors: make("td"), turnaround: make("td", "n") };
    row.element = make("tr", "", make("td", "", anchor(places.drive(name), "", name)), row.state, row.total, row.errors, row.turnaround);
    body.append(row.element);
    return row;
  };
}

function showMember(row, drive) {
  const { ok, exception, timeout, corrupt } = drive.transactions;
  text(row.state, stateWords(stateOf(drive)));
  text(row.total, String(ok + exception + timeout + corrupt));
  text(row.errors, failures(drive.transactions));
  text(row.turnaround, drive.turnaround_ms === null ? "—" : `${decimal(drive.turnaround_ms, 1)} ms`);
}

/// The failed exchanges by what happened.
export function failures({ timeout, corrupt, exception }) {
  const told = [[timeout, t("timeout")], [corrupt, t("corrupt")], [exception, t("exception")]].filter(([count]) => count > 0);
  return told.map(([count, what]) => `${count} ${what}`).join(", ") || t("none");
}

/// Load and fast cycle of the last hour, the cycle against what was aimed at.
function lastHour() {
  const group = new PlotGroup({ name: t("Cursor of load and cycle"), moment: (at) => clock(new Date(at)), label: (at) => clock(new Date(at)).slice(-8, -3) });
  const load = group.add({ title: TITLES.load, unit: "%", digits: 1 });
  const cycle = group.add({ title: TITLES.fast, unit: "ms", digits: 1 });
  return {
    element: group.element,
    show({ hour, fast }) {
      const step = hour.step_s * 1000;
      const from = Date.parse(hour.from);
      const samples = (steps, factor) => steps.map((figures, place) => figures && { t: from + (place + 0.5) * step, low: figures[0] * factor, high: figures[1] * factor, value: figures[2] * factor });
      group.setRange(from, from + step * hour.load_ratio.length, step);
      load.show(samples(hour.load_ratio, 100), { reach: 1.5 * step, includes: [0, 100] });
      cycle.show(samples(hour.fast_cycle_ms, 1), { reach: 1.5 * step, aim: fast.aim_ms, includes: [0, 1.2 * fast.aim_ms] });
      group.moved();
    },
  };
}

/// One line.
export function openLine(root, { name }) {
  const facts = busFacts();
  const strips = make("div", "strips");
  const answers = make("div", "histogram");
  const drives = table(t("Drives of this line"), t("Drive"), t("State"), t("Transactions"), t("Errors"), t("Turnaround"));
  const diagnosis = diagnosisPanel();
  const unknown = make("p", "note");
  const card = make("article", "card", make("p", "state", facts.badge), facts.where, facts.why, facts.bar, facts.list, unknown);
  const hour = lastHour();
  root.append(make("h1", "", t("Line {line}", { line: name })), card, diagnosis.element, section("hour", t("Load and cycle, the last hour"), hour.element),
    section("errors", t("Errors by drive, the last hour"), strips), section("turnaround", t("Turnaround times of the drives"), answers), section("members", t("Drives"), drives.element));
  diagnosis.show(null);
  let nextDiagnosis = 0;
  const rows = new Map();
  const create = memberRow(drives.body);
  return {
    title: t("Line {line}", { line: name }),
    async refresh(load) {
      const path = `buses/${encodeURIComponent(name)}`;
      const [bus, all] = await Promise.all([load(path), load("drives?points=")]);
      showFacts(facts, bus);
      hide(unknown, !bus.unknown_drives?.length);
      text(unknown, t("Devices without an entry in the configuration answer on this line: addresses {addresses}.", { addresses: (bus.unknown_drives ?? []).join(", ") }));
      strip(strips, bus.by_drive);
      histogram(answers, bus.turnaround);
      hour.show(bus);
      const members = all.filter((drive) => drive.bus === name);
      keyed(rows, members, create, showMember);
      if (performance.now() >= nextDiagnosis) {
        nextDiagnosis = performance.now() + DIAGNOSIS_MS;
        diagnosis.show(await optional(load(`${path}/diagnosis`)));
      }
    },
  };
}
