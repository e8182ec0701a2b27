// Plots over time, drawn as SVG: a band from minimum to maximum, a line through the last values, gaps left as gaps. The plots
// of a group share their range and one cursor, which is moved by pointer or by keyboard.

import { draw, make, text } from "./common.js";
import { decimal, t, unitOf } from "./texts.js";

const LEFT = 52;
const RIGHT = 10;
const TOP = 8;
const BOTTOM = 20;
const SECOND = 1000;
const STEPS = [0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 10800, 21600].map((s) => s * SECOND);
// Labels of the time axis, px apart at least.
const LABEL_PX = 84;

/// A round step, so that there are about `count` of them in `span`.
export function roundStep(span, count) {
  const raw = span / count;
  const power = 10 ** Math.floor(Math.log10(raw));
  return [1, 2, 5, 10].map((factor) => factor * power).find((step) => step >= raw * 0.999);
}

/// Lower and upper end of an axis that shows these values, and its step.
export function axis(low, high) {
  if (!(low <= high)) return { low: 0, high: 1, step: 0.5 };
  let [from, to] = [low, high];
  const least = Math.max(Math.abs(from), Math.abs(to)) * 0.02 || 1;
  if (to - from < least) [from, to] = [from - least / 2, to + least / 2];
  // A scale that begins close above zero would mislead.
  if (from > 0 && from < 0.4 * to) from = 0;
  const step = roundStep(to - from, 3);
  return { low: Math.floor(from / step + 1e-9) * step, high: Math.ceil(to / step - 1e-9) * step, step };
}

/// Runs of samples without a gap in between; `null` is a gap.
export function runs(samples) {
  const all = [];
  let run = null;
  for (const sample of samples) {
    if (!sample) run = null;
    else if (run) run.push(sample);
    else all.push((run = [sample]));
  }
  return all;
}

/// The sample in force at `t`: the last one not after it, `null` in a gap. Samples have their time or are gaps.
export function sampleAt(samples, t, reach) {
  let [from, to] = [0, samples.length];
  while (from < to) {
    const middle = (from + to) >> 1;
    let known = middle;
    while (known < to && !samples[known]) known += 1;
    if (known < to && samples[known].t <= t) from = known + 1;
    else to = middle;
  }
  const sample = samples[from - 1];
  return sample && t - sample.t <= reach ? sample : null;
}

/// How long a sample is in force, ms: so many of the usual intervals between two.
export function reachOf(samples, intervals) {
  const apart = samples.slice(1).map((sample, place) => sample.t - samples[place].t).sort((a, b) => a - b);
  return apart.length ? intervals * apart[apart.length >> 1] : Infinity;
}

/// The samples with `null` where there was none for longer than their reach, or one says that there is none.
export function withGaps(known, intervals) {
  const reach = reachOf(known, intervals);
  const samples = [];
  let last = null;
  for (const sample of known) {
    if (sample.none || (last && sample.t - last.t > reach)) samples.push(null);
    if (!sample.none) samples.push(sample);
    last = sample;
  }
  return { samples, reach };
}

/// Those between `from` and `to`, and the next on either side.
export function within(samples, from, to) {
  const first = samples.findLastIndex((sample) => sample && sample.t < from);
  const after = samples.findIndex((sample) => sample && sample.t > to);
  return samples.slice(Math.max(0, first), after < 0 ? samples.length : after + 1);
}

function ticks(low, high, step) {
  const all = [];
  for (let value = Math.ceil(low / step - 1e-9) * step; value <= high + step * 1e-6; value += step) all.push(value);
  return all;
}

const place = (n) => n.toFixed(1);

/// One plot. `digits`: of its figures; `directed`: a value below zero is read as a magnitude and an arrow.
class Plot {
  constructor(group, { title, unit, digits, directed = false }) {
    Object.assign(this, { group, title, unit: unitOf(unit), digits, directed, samples: [], set: [], marks: [], reach: Infinity, aim: null, includes: [], resting: undefined, loading: true });
    this.svg = draw("svg", { role: "img", "aria-label": title, height: group.height });
    this.reading = make("span", "reading");
    this.spread = make("span", "sub");
    this.head = make("figcaption", "", make("b", "", title), this.spread, this.reading);
    this.element = make("figure", "plot", this.head, this.svg);
    this.needle = draw("line", { class: "needle", y1: TOP, y2: group.height - BOTTOM });
    this.dot = draw("circle", { class: "dot", r: 3.5 });
    this.svg.addEventListener("pointermove", (event) => group.point(this.timeAt(event)));
    this.svg.addEventListener("pointerdown", (event) => group.point(this.timeAt(event)));
    this.svg.addEventListener("pointerleave", () => group.leave());
  }

  timeAt(event) {
    const { left } = this.svg.getBoundingClientRect();
    const { from, to } = this.group.range;
    return from + ((event.clientX - left - LEFT) / this.width) * (to - from);
  }

  /// `reach`: how long a sample is in force, ms; `aim`: what the values are meant to be now, said as `aimed`, and `set`: what they were
  /// meant to be, as samples; `includes`: values that the axis has in any case.
  show(samples, { reach = Infinity, marks = [], set = [], aim = null, aimed = t("target {time}"), includes = [] } = {}) {
    Object.assign(this, { samples, set, reach, marks, aim, aimed, includes, loading: false });
    this.render();
  }

  /// Empty until values of another time are there.
  wait() {
    Object.assign(this, { samples: [], set: [], loading: true });
    this.render();
  }

  /// What it says while the cursor rests: the value of now, of which the samples may know later.
  now(value) {
    this.resting = value;
    if (this.scale) this.cursor();
  }

  x(t) {
    const { from, to } = this.group.range;
    return LEFT + ((t - from) / (to - from)) * this.width;
  }

  y(value) {
    const { low, high } = this.scale;
    return TOP + (1 - (value - low) / (high - low)) * (this.group.height - TOP - BOTTOM);
  }

  render() {
    const { range: { from, to }, height } = this.group;
    this.width = Math.max(50, (this.svg.clientWidth || 600) - LEFT - RIGHT);
    this.visible = within(this.samples, from, to);
    const known = this.visible.filter(Boolean);
    const wanted = within(this.set, from, to).filter(Boolean).map(({ value }) => value);
    const low = known.reduce((least, sample) => Math.min(least, sample.low), Infinity);
    const high = known.reduce((most, sample) => Math.max(most, sample.high), -Infinity);
    this.scale = axis(Math.min(low, ...wanted, ...this.includes), Math.max(high, ...wanted, ...this.includes));
    // Its own view cuts off what lies beyond the range.
    const inner = draw("svg", { x: LEFT, width: this.width, height, viewBox: `${LEFT} 0 ${this.width} ${height}` }, ...this.gaps(), ...this.lines());
    const parts = [...this.grid(), inner, ...this.events()];
    if (known.length === 0) parts.push(draw("text", { class: "none", x: LEFT + this.width / 2, y: height / 2 }, this.loading ? t("loading …") : t("no values in this period")));
    this.svg.replaceChildren(...parts, this.needle, this.dot);
    const said = known.length ? t("between {low} and {high} {unit}", { low: this.figure(low), high: this.figure(high), unit: this.unit }) : this.loading ? t("loading …") : t("no values in this period");
    this.svg.setAttribute("aria-label", `${this.title}, ${this.group.spoken()}: ${said}`);
    this.cursor();
  }

  figure(value) {
    return decimal(value, this.digits);
  }

  grid() {
    const { from, to } = this.group.range;
    const { height } = this.group;
    const parts = [];
    const digits = Math.max(0, Math.ceil(-Math.log10(this.scale.step) - 1e-9));
    for (const value of ticks(this.scale.low, this.scale.high, this.scale.step)) {
      const y = place(this.y(value));
      parts.push(draw("line", { class: "grid", x1: LEFT, x2: LEFT + this.width, y1: y, y2: y }));
      parts.push(draw("text", { class: "at-y", x: LEFT - 7, y: this.y(value) + 4 }, decimal(value, digits)));
    }
    const wanted = (to - from) / Math.max(1, Math.floor(this.width / LABEL_PX));
    const step = STEPS.find((each) => each >= wanted) ?? STEPS[STEPS.length - 1];
    // Full hours and minutes of the place where the page is looked at.
    const shift = this.group.relative ? 0 : new Date(to).getTimezoneOffset() * 60 * SECOND;
    for (const t of ticks(from - shift, to - shift, step)) {
      const x = this.x(t + shift);
      parts.push(draw("line", { class: "grid", x1: place(x), x2: place(x), y1: TOP, y2: height - BOTTOM }));
      if (x > LEFT + 14 && x < LEFT + this.width - 14) {
        parts.push(draw("text", { class: "at-x", x: place(x), y: height - 5 }, this.group.label(t + shift, step)));
      }
    }
    return parts;
  }

  gaps() {
    const { from, to } = this.group.range;
    const parts = [];
    const add = (begin, end) => {
      const [left, right] = [this.x(Math.max(begin, from)), this.x(Math.min(end, to))];
      if (right - left > 1) parts.push(draw("rect", { class: "gap", x: place(left), y: TOP, width: place(right - left), height: this.group.height - TOP - BOTTOM }));
    };
    let end = from;
    for (const run of runs(this.visible)) {
      add(end, run[0].t);
      end = run[run.length - 1].t + Math.min(this.reach, to - from);
    }
    add(end, to);
    return parts;
  }

  lines() {
    let band = "";
    let line = "";
    for (const run of runs(this.visible)) {
      const points = run.map((sample) => ({ x: place(this.x(sample.t)), ...sample }));
      if (points.some((point) => point.high > point.low)) {
        const upper = points.map((point) => `${point.x} ${place(this.y(point.high))}`);
        const lower = points.map((point) => `${point.x} ${place(this.y(point.low))}`).reverse();
        band += `M${upper.concat(lower).join("L")}Z`;
      }
      line += `M${points.map((point) => `${point.x} ${place(this.y(point.value))}`).join("L")}`;
      // A sample between two gaps is a point.
      if (points.length === 1) line += "h0.1";
    }
    const drawn = line ? [draw("path", { class: "band", d: band }), draw("path", { class: "curve", d: line })] : [];
    return [...drawn, ...this.aims()];
  }

  /// What the values are meant to be: steps through its past, else a line at what it is now.
  aims() {
    const { from, to } = this.group.range;
    const steps = runs(within(this.set, from, to)).map((run) => {
      const [first, ...rest] = run.map((sample) => [place(this.x(sample.t)), place(this.y(sample.value))]);
      return `M${first.join(" ")}${rest.map(([x, y]) => `H${x}V${y}`).join("")}h0.1`;
    });
    const drawn = steps.length ? [draw("path", { class: "aim", d: steps.join("") })] : [];
    if (this.aim === null) return drawn;
    const y = place(this.y(this.aim));
    if (!steps.length) drawn.push(draw("line", { class: "aim", x1: LEFT, x2: LEFT + this.width, y1: y, y2: y }));
    // Its past stands on the left.
    const at = steps.length ? { x: LEFT + this.width - 4, "text-anchor": "end" } : { x: LEFT + 4 };
    const said = `${this.figure(this.directed ? Math.abs(this.aim) : this.aim)} ${this.unit}`;
    return [...drawn, draw("text", { class: "at-aim", y: this.y(this.aim) + 13, ...at }, this.aimed.replace("{time}", said))];
  }

  events() {
    const { from, to } = this.group.range;
    return this.marks.filter((mark) => mark.t >= from && mark.t <= to).map((mark) => {
      const x = place(this.x(mark.t));
      const bottom = this.group.height - BOTTOM;
      const line = draw("path", { class: `mark ${mark.colour}`, d: `M${x} ${TOP}V${bottom}M${x - 4} ${TOP}h8l-4 6z` });
      line.append(draw("title", {}, mark.text));
      return line;
    });
  }

  cursor() {
    const { cursor, range } = this.group;
    const at = cursor ?? range.to;
    const sample = sampleAt(this.samples, at, this.reach);
    const shown = cursor !== null;
    this.needle.setAttribute("visibility", shown ? "visible" : "hidden");
    this.dot.setAttribute("visibility", shown && sample ? "visible" : "hidden");
    if (shown) {
      this.needle.setAttribute("x1", place(this.x(cursor)));
      this.needle.setAttribute("x2", place(this.x(cursor)));
    }
    if (sample) {
      this.dot.setAttribute("cx", place(this.x(sample.t)));
      this.dot.setAttribute("cy", place(this.y(sample.value)));
    }
    const resting = !shown && this.resting !== undefined;
    const isReverse = this.directed && sample?.value < 0;
    const value = sample ? `${this.figure(isReverse ? -sample.value : sample.value)} ${this.unit}${isReverse ? " ←" : ""}` : t("no value");
    const spread = sample && sample.high > sample.low ? `${this.figure(sample.low)} … ${this.figure(sample.high)}` : "";
    const wanted = sampleAt(this.set, at, this.reach);
    const aimed = wanted ? t("set {value}", { value: `${this.figure(this.directed ? Math.abs(wanted.value) : wanted.value)} ${this.unit}` }) : "";
    text(this.reading, resting ? this.resting : value);
    text(this.spread, resting ? "" : [spread, aimed].filter(Boolean).join(" · "));
  }
}

/// Plots that share range and cursor. `name`: of the cursor, spoken; `relative`: times are seconds from a moment.
export class PlotGroup {
  constructor({ name, height = 132, relative = false, label, moment, rests = true }) {
    Object.assign(this, { height, relative, label, moment, rests, plots: [], cursor: null, range: { from: 0, to: 1 }, listeners: [], drawers: [] });
    this.slider = make("input", "cursor");
    this.slider.type = "range";
    this.slider.setAttribute("aria-label", name);
    this.slider.addEventListener("input", () => this.point(Number(this.slider.value)));
    this.when = make("output", "when");
    this.grid = make("div", "plots");
    this.element = make("div", "plot-group", this.grid, make("div", "scrubber", this.slider, this.when));
    new ResizeObserver(() => this.render()).observe(this.grid);
  }

  add(options) {
    const plot = new Plot(this, options);
    this.plots.push(plot);
    this.grid.append(plot.element);
    return plot;
  }

  /// Shows another time; the cursor moves in steps of that many ms.
  setRange(from, to, step) {
    Object.assign(this, { range: { from, to }, step });
    if (this.cursor !== null && this.cursor < from) this.cursor = null;
    Object.assign(this.slider, { min: from, max: to, step });
    this.render();
    this.moved();
  }

  spoken() {
    return t("{from} to {to}", { from: this.moment(this.range.from), to: this.moment(this.range.to) });
  }

  /// Puts the cursor to that time; at the end of the range it rests.
  point(t) {
    const { from, to } = this.range;
    const within = Math.min(to, Math.max(from, t));
    // The slider ends at its last whole step.
    this.cursor = this.rests && within > to - this.step ? null : within;
    this.moved();
  }

  leave() {
    if (!this.rests) return;
    this.cursor = null;
    this.moved();
  }

  moved() {
    for (const plot of this.plots) if (plot.scale) plot.cursor();
    const at = this.cursor ?? this.range.to;
    if (Number(this.slider.value) !== at) this.slider.value = String(at);
    const values = this.plots.map((plot) => `${plot.title} ${plot.reading.textContent}`).join(", ");
    text(this.when, this.cursor === null && this.rests ? t("now") : this.moment(at));
    this.slider.setAttribute("aria-valuetext", `${this.when.textContent}: ${values}`);
    for (const listener of this.listeners) listener(at);
  }

  render() {
    for (const plot of this.plots) plot.render();
    for (const drawer of this.drawers) drawer();
  }
}
