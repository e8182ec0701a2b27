// Trends of a drive: what the gateway keeps in memory of its points, over 10 minutes, an hour or a day.

import { anchor, clock, digitsOf, directionOf, figure, hide, isDirected, make, section, text, titleOf } from "./common.js";
import { PlotGroup } from "./plot.js";
import { t, unitOf } from "./texts.js";

const MINUTE = 60000;
// Words, the time as the gateway takes it, and how often what it shows changes.
const SPANS = [["10 min", "10min", 2000], ["1 h", "1h", 5000], ["24 h", "24h", 60000]];
// The frequency takes the place of a speed that the family lacks.
const SHOWN = [["actual_speed", "output_frequency"], ["motor_current"], ["motor_torque"], ["motor_power"], ["dc_link_voltage"], ["heatsink_temperature"]];

/// Samples of the interface as a plot takes them: each in the middle of its step, `null` where there was no good value.
export function samplesOf({ samples, step_s: step }) {
  return samples.map((sample) => sample && { t: sample[0] + step * 500, low: sample[1], high: sample[2], value: sample[3] });
}

function nowOf(name, points) {
  const point = points[name];
  if (!point || point.value === null) return "—";
  if (point.quality !== "good" || point.contradicted) return t("not good");
  if (!isDirected(name)) return `${figure(point.value, point.unit)} ${unitOf(point.unit)}`;
  const [arrow] = directionOf(points, point).split(" ");
  return `${figure(Math.abs(point.value), point.unit)} ${unitOf(point.unit)} ${arrow}`.trim();
}

// The reference in the plot of each speed.
const REFERENCES = { actual_speed: "speed_reference", output_frequency: "frequency_reference" };

// Families that turn by a bit have a reference without a sign.
const turned = (value, speed) => (speed < 0 ? -Math.abs(value) : value);

/// The reference, in the direction of the speed: a dashed line through its past, or the one of now where the gateway keeps none.
function referenceOf({ point, samples }, replies, values) {
  const name = REFERENCES[point];
  const past = replies.find((reply) => reply.point === name);
  const set = past && samplesOf({ ...past, samples: past.samples.map((sample, at) => sample && [sample[0], ...Array(3).fill(turned(sample[3], samples[at]?.[3]))]) });
  const now = values[name];
  if (now?.quality !== "good" || typeof now.value !== "number") return { set };
  const aim = turned(now.value, values[point]?.value);
  return { set, aim, aimed: t("reference now {time}"), includes: [aim] };
}

/// The trends of one drive; `marks` are its events.
export function trends(drive) {
  const chosen = { span: SPANS[0], points: null, next: 0, asked: "" };
  const plots = new Map();
  const links = [];
  const group = new PlotGroup({
    name: t("Cursor of the trends"), moment: (at) => clock(new Date(at)),
    label: (at, step) => clock(new Date(at)).slice(-8, step < MINUTE ? undefined : -3),
  });
  const buttons = SPANS.map((span) => {
    const button = make("button", "chip", span[0]);
    button.type = "button";
    button.addEventListener("click", () => choose(span));
    return button;
  });
  const files = make("p", "note files");
  const note = make("p", "note", t("Loading …"));
  const choices = make("div", "choices", ...buttons);
  choices.setAttribute("role", "group");
  choices.setAttribute("aria-label", t("Time shown"));
  const element = section("trends", t("Trends"), choices, note, group.element, files);
  const all = `drives/${encodeURIComponent(drive)}/trend`;
  const address = (query, span) => `${all}?${query}from=${span[1]}`;

  function choose(span) {
    chosen.span = span;
    chosen.next = 0;
    buttons.forEach((button, place) => button.setAttribute("aria-pressed", String(SPANS[place] === span)));
    for (const { query, element } of links) element.setAttribute("href", `api/v1/${address(query, span)}&format=csv`);
    for (const plot of plots.values()) plot.wait();
  }

  function create(points) {
    const first = (names) => names.map((name) => points.find(({ point }) => point === name)).find(Boolean);
    chosen.points = SHOWN.map(first).filter(Boolean);
    const references = chosen.points.map(({ point }) => REFERENCES[point]).filter((name) => points.some(({ point }) => point === name));
    chosen.asked = [...chosen.points.map(({ point }) => point), ...references].join(",");
    for (const { point, unit } of chosen.points) plots.set(point, group.add({ title: titleOf(point), unit, digits: digitsOf(unit), directed: isDirected(point) }));
    // The same links for every time: new ones would take the focus from those that somebody is on.
    const titles = chosen.points.map(({ point }) => [`point=${point}&`, titleOf(point)]);
    links.push(...[["", t("all")], ...titles].map(([query, title]) => ({ query, element: anchor("", "", title) })));
    if (titles.length) files.append(t("As CSV:"), ...links.flatMap(({ element }) => [" ", element]));
    choose(chosen.span);
  }

  choose(SPANS[0]);
  return {
    element,
    /// What the plots say while their cursor rests.
    showNow(points) {
      for (const [name, plot] of plots) plot.now(nowOf(name, points));
    },
    async refresh(load, marks, values) {
      if (performance.now() < chosen.next) return;
      const span = chosen.span;
      if (!chosen.points) create((await load(all)).points);
      // In one request, so that all have the same times; one alone comes without a list.
      const replies = chosen.points.length ? [await load(address(`point=${chosen.asked}&`, span))].flat() : [];
      if (span !== chosen.span) return;
      chosen.next = performance.now() + span[2];
      text(note, replies.length ? "" : t("This family has none of the points with trends."));
      hide(note, replies.length > 0);
      if (!replies.length) return;
      const step = replies[0].step_s * 1000;
      group.setRange(Date.parse(replies[0].from), Date.parse(replies[0].to), step);
      for (const reply of replies) plots.get(reply.point)?.show(samplesOf(reply), { reach: 1.5 * step, marks, ...referenceOf(reply, replies, values) });
      group.moved();
    },
  };
}
