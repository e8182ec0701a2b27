// Small drawings of counts: errors by minute, and how often which time was taken.

import { anchor, arrange, draw, fill, hide, keyed, make, places, text } from "./common.js";
import { decimal, t } from "./texts.js";

const HEIGHT = 22;

// Each minute has a bar: its height says as much as its colour. One error is seen beside hundreds.
const level = (count) => (count === 0 ? 0 : Math.min(1, 0.25 + Math.log10(count) / 4));

function heat(count) {
  if (count === 0) return "none";
  return count < 3 ? "few" : count < 20 ? "some" : "many";
}

/// One strip of counts by minute, oldest first; `null` where the gateway did not run.
export function minutes(counts, name) {
  const svg = draw("svg", { role: "img", viewBox: `0 0 ${counts.length * 10} ${HEIGHT}`, preserveAspectRatio: "none", class: "minutes" });
  const ago = (minute) => (minute === counts.length - 1 ? t("this minute") : t("{minutes} min ago", { minutes: counts.length - 1 - minute }));
  counts.forEach((count, minute) => {
    if (count === null) return;
    const height = Math.max(2, level(count) * HEIGHT);
    const bar = draw("rect", { class: heat(count), x: minute * 10 + 1, y: HEIGHT - height, width: 8, height });
    bar.append(draw("title", {}, `${ago(minute)}: ${count}`));
    svg.append(bar);
  });
  const total = counts.reduce((sum, count) => sum + count, 0);
  const most = Math.max(0, ...counts);
  svg.setAttribute("aria-label", total ? t("{name}: {total} in the last hour, most {when}: {most}", { name, total, most, when: ago(counts.lastIndexOf(most)) }) : t("{name}: none in the last hour", { name }));
  return { svg, total };
}

/// The times below strips of an hour; readers of the screen have them with each strip.
export function minuteAxis() {
  const times = [60, 45, 30, 15].map((minutes) => make("span", "", t("−{minutes} min", { minutes })));
  const element = make("div", "minute-axis", ...times, make("span", "", t("now")));
  element.setAttribute("aria-hidden", "true");
  return element;
}

/// A strip for each drive of a line. Items have `drive` and `errors`.
export function strip(parent, items) {
  parent.entries ??= new Map();
  parent.axis ??= parent.appendChild(make("div", "strip", minuteAxis()));
  const create = ({ name }) => {
    const entry = { place: make("div", "strip-bars"), count: make("span", "count") };
    entry.element = make("div", "strip", anchor(places.drive(name), "", name), entry.place, entry.count);
    parent.axis.before(entry.element);
    return entry;
  };
  keyed(parent.entries, items.map(({ drive, errors }) => ({ name: drive, errors })), create, (entry, item) => {
    const state = item.errors.join();
    if (entry.state === state) return;
    entry.state = state;
    const { svg, total } = minutes(item.errors, t("errors of {drive}", { drive: item.name }));
    entry.place.replaceChildren(svg);
    text(entry.count, total === 0 ? t("no error") : total === 1 ? t("1 error") : t("{count} errors", { count: total }));
  });
}

const limit = (ms) => (ms >= 1000 ? `${ms / 1000} s` : `${ms} ms`);

/// How often it took how long: what came before the first time and after the last that was ever taken is left out.
export function histogram(parent, { le_ms: bounds, counts }) {
  const first = counts.findIndex((count) => count > 0);
  const last = counts.findLastIndex((count) => count > 0);
  const label = (place) => {
    if (bounds[place] === null) return t("over {time}", { time: limit(bounds[place - 1]) });
    return place === 0 ? t("up to {time}", { time: limit(bounds[0]) }) : t("{from} to {to}", { from: limit(bounds[place - 1]), to: limit(bounds[place]) });
  };
  const items = first < 0 ? [] : counts.slice(first, last + 1).map((count, place) => ({ label: label(first + place), count }));
  const total = items.reduce((sum, item) => sum + item.count, 0);
  const most = Math.max(1, ...items.map((item) => item.count));
  parent.rows ??= parent.appendChild(make("dl"));
  parent.none ??= parent.appendChild(make("p", "note", t("No drive has replied yet.")));
  hide(parent.none, total > 0);
  parent.entries ??= new Map();
  const create = () => {
    const entry = { label: make("dt"), fill: make("i"), count: make("span", "count"), share: make("span", "sub") };
    entry.element = make("div", "", entry.label, make("dd", "", make("span", "bar", entry.fill), entry.count, entry.share));
    return entry;
  };
  keyed(parent.entries, items.map((item) => ({ ...item, name: item.label })), create, (entry, item) => {
    text(entry.label, item.label);
    text(entry.count, String(item.count));
    text(entry.share, `${decimal((100 * item.count) / total, item.count && item.count < total / 100 ? 2 : 0)} %`);
    fill(entry.fill, item.count / most);
  });
  arrange(parent.rows, items.map((item) => parent.entries.get(item.label).element));
}
