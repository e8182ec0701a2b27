// The controls of one drive: stop, start and direction, reference, reset.

import { directionWord, hide, make, text } from "./common.js";
import { asked, closed } from "./questions.js";
import { numberOf, plain, t, unitOf } from "./texts.js";

const isGood = (point) => point !== undefined && point.quality === "good" && point.value !== null;

function button(name, words, label, action) {
  const made = make("button", name, words);
  made.type = "button";
  if (label) made.setAttribute("aria-label", label);
  made.addEventListener("click", action);
  return made;
}

/// The point by which the reference of a drive is given, with its limits.
function referenceOf(about) {
  const points = about ? about.points : [];
  return points.find((point) => point.name === "speed_reference") || points.find((point) => point.name === "frequency_reference");
}

const hasReverse = (about) => Boolean(about?.points.some((point) => point.name === "reverse"));

const figureOf = (value, unit) => `${plain(value)} ${unitOf(unit)}`;

function limits({ minimum, maximum, unit: name }) {
  const unit = unitOf(name);
  if (minimum === null && maximum === null) return "";
  if (minimum === null) return t("up to {maximum} {unit}", { maximum: plain(maximum), unit });
  if (maximum === null) return t("from {minimum} {unit}", { minimum: plain(minimum), unit });
  return t("from {minimum} to {maximum} {unit}", { minimum: plain(minimum), maximum: plain(maximum), unit });
}

/// The reference that stands in the drive, in words.
function standingReference({ points }) {
  const point = [points.speed_reference, points.frequency_reference].find(isGood);
  return point ? figureOf(Math.round(point.value * 100) / 100, point.unit) : t("reference unknown");
}

/// The direction that the drive has been ordered, else the one that it shows: true for reverse.
const orderedReverse = ({ points }) => [points.reverse, points.reversed].find(isGood)?.value === true;

// ---- Who holds the drive

/// Whether another client holds it.
const isHeldByOther = ({ json, about }) => json.hold === "held" && json.holder !== about?.principal;

/// Whether this login ranks above the client that holds it.
const mayTakeOver = (drive) => isHeldByOther(drive) && (drive.about?.outranks ?? []).includes(drive.json.holder_rank);

/// Whether this login holds it.
const isHeldHere = ({ json, about }) => json.hold === "held" && json.holder === about?.principal;

/// Whether this login may take the drive without a start.
function mayTake(drive) {
  const { hold, holder, holder_rank: rank } = drive.json;
  if (!drive.about?.principal) return false;
  return hold === "free" || (hold === "reserved" && (holder === drive.about.principal || drive.about.outranks.includes(rank))) || mayTakeOver(drive);
}

function holdWords(drive) {
  const { hold, holder, holder_rank: rank, hold_left_s: left } = drive.json;
  if (isHeldHere(drive)) return t("held by you, {left} s left", { left });
  if (isHeldByOther(drive)) return t("held by {holder} ({rank}), {left} s left", { holder, rank, left });
  if (hold === "reserved") return t("stopped by {holder} ({rank}), reserved for {left} s", { holder, rank, left });
  if (hold === "local") return t("under local control");
  return "";
}

// ---- The reference

function buildReference(panel, name, { command, tell, known }) {
  panel.input = Object.assign(make("input"), { type: "text", inputMode: "decimal", autocomplete: "off", required: true });
  panel.unit = make("span", "unit");
  panel.range = make("span", "sub");
  panel.understood = make("output", "understood");
  panel.label = make("span", "", t("Speed reference"));
  panel.set = Object.assign(make("button", "operate-button", t("Set")), { type: "submit" });
  panel.set.setAttribute("aria-label", t("Set the reference of {drive}", { drive: name }));
  panel.reference = make("form", "operate-reference", make("label", "", panel.label, " ", panel.input), panel.unit, panel.set, panel.range, panel.understood);
  panel.reference.noValidate = true;
  const typed = () => reading(panel.input.value, referenceOf(known(name).about));
  panel.input.addEventListener("input", () => {
    const { words, problem } = panel.input.value.trim() ? typed() : { words: "", problem: "" };
    text(panel.understood, problem || `= ${words}`.replace(/^= $/, ""));
    panel.understood.className = `understood ${problem ? "bad" : ""}`;
  });
  panel.reference.addEventListener("submit", (event) => {
    event.preventDefault();
    const { point, value, words, problem } = typed();
    if (!problem) return command(name, { [point.name]: value }, t("Reference {value}", { value: words }));
    tell(name, t("Reference: {problem}; nothing was sent", { problem }), false);
    panel.input.focus();
  });
}

/// What was typed as a value of the point, in words, and what is wrong with it.
function reading(typed, point) {
  const value = numberOf(typed);
  const allowed = limits(point);
  if (value === null) return { point, problem: allowed ? t("enter a number {limits}", { limits: allowed }) : t("enter a number") };
  const words = figureOf(value, point.unit);
  const outside = (point.minimum !== null && value < point.minimum) || (point.maximum !== null && value > point.maximum);
  return { point, value, words, problem: outside ? t("{value} is not {limits}", { value: words, limits: allowed }) : "" };
}

// ---- Start and direction

// Why the motor stands by a stop: the evidence says whose.
const STOPS = ["stopped_by_order", "supervision", "stopped_by_gateway", "stopped_by_interlock"];

/// What the question rests on. The reference is not part of that: it is shown as it is, and the answer does not set it.
function restsOn({ json, about }) {
  const { bus, address, profile, access, state, online, starts, held, hold, holder, holder_rank: rank } = json;
  const stop = json.why.find(({ cause }) => STOPS.includes(cause));
  return JSON.stringify([bus, address, profile, access, state, online, starts, held, hold, holder, rank, stop?.cause, stop?.evidence, orderedReverse(json), hasReverse(about)]);
}

// One question for both: what is about to happen is read before it is done.
function buildQuestion(panel, name, actions) {
  const { tell, known } = actions;
  panel.asked = make("span");
  panel.choice = make("span", "operate-directions");
  panel.choice.setAttribute("role", "radiogroup");
  panel.choice.setAttribute("aria-label", t("Direction of {drive}", { drive: name }));
  panel.directions = [false, true].map((isReverse) => {
    const radio = Object.assign(make("input"), { type: "radio", name: `direction of ${name}`, value: String(isReverse) });
    radio.addEventListener("change", () => ask(panel, name, known(name)));
    panel.choice.append(make("label", "", radio, ` ${directionWord(isReverse)}`));
    return radio;
  });
  panel.really = button("operate-button operate-start", "", "", () => {
    const { send } = panel.order;
    panel.close();
    send();
  });
  panel.cancel = button("operate-button", t("Cancel"), t("Cancel: do not start {drive}", { drive: name }), () => panel.close());
  panel.question = make("span", "operate-confirm", panel.asked, panel.choice, panel.really, panel.cancel);
  panel.question.hidden = true;
  panel.start = button("operate-button", t("Start …"), t("Start {drive}", { drive: name }), () => panel.open("start"));
  panel.turn = button("operate-button", "", "", () => panel.open("turn"));
  panel.take = button("operate-button", "", "", () => (isHeldByOther(known(name)) ? panel.open("take") : actions.hold(name, "take", t("Take"))));
  panel.release = button("operate-button", t("Release"), t("Release {drive}", { drive: name }), () => actions.hold(name, "release", t("Release")));
  panel.actions = actions;
  panel.open = (kind) => {
    const { json } = known(name);
    panel.asking = kind;
    panel.restsOn = restsOn(known(name));
    panel.takesOver = kind === "start" && mayTakeOver(known(name));
    panel.directions[orderedReverse(json) ? 1 : 0].checked = true;
    panel.target = !orderedReverse(json);
    ask(panel, name, known(name));
    panel.show(known(name));
    hide(panel.question, false);
    asked(panel.asks);
    panel.really.focus();
  };
  panel.close = (why = "") => {
    if (!panel.asking) return;
    const from = panel[panel.asking];
    const hadFocus = panel.question.contains(document.activeElement);
    panel.asking = null;
    closed(panel.asks);
    hide(panel.question, true);
    panel.show(known(name));
    if (why) tell(name, t("{what}: nothing was sent, {why}", { what: panel.order.what, why }), false);
    // What somebody presses next, meant for the question, meets no control.
    if (hadFocus) (why || from.hidden ? panel.place : from).focus();
  };
  panel.asks = { element: panel.question, end: panel.close };
}

/// Writes the question; the reference may change while it is asked.
function ask(panel, name, { json, about }) {
  const { command, hold } = panel.actions;
  const starts = panel.asking === "start";
  const { takesOver } = panel;
  const order = (points, what) => ({ what, send: () => command(name, points, what, takesOver) });
  const isReverse = starts ? panel.directions[1].checked : panel.target;
  const told = { drive: name, direction: directionWord(isReverse), reference: standingReference(json) };
  hide(panel.choice, !starts || !hasReverse(about));
  if (panel.asking === "take") {
    const what = t("Take over");
    text(panel.asked, t("Take {drive} over from {holder} ({rank})? The motor goes on as it is.", { drive: name, holder: json.holder, rank: json.holder_rank }));
    text(panel.really, t("Take over now"));
    panel.order = { what, send: () => hold(name, "break", what) };
  } else if (!starts) {
    text(panel.asked, t("{drive} {direction}, {reference}? The motor will change direction.", told));
    text(panel.really, t("Change direction now"));
    panel.order = order({ reverse: isReverse }, t("Direction {direction}", told));
  } else if (hasReverse(about)) {
    text(panel.asked, t("Start {drive} {direction}, {reference}? The motor will turn.", told));
    text(panel.really, panel.takesOver ? t("Take over and start") : t("Start now"));
    panel.order = order({ run: true, reverse: isReverse }, t("Start {direction}", told));
  } else {
    text(panel.asked, t("Start {drive}, {reference}? The motor will turn.", told));
    text(panel.really, panel.takesOver ? t("Take over and start") : t("Start now"));
    panel.order = order({ run: true }, t("Start"));
  }
  panel.really.setAttribute("aria-label", `${panel.really.textContent}: ${name}`);
}

// ---- All of them

function stopButton(name, actions) {
  const made = button("operate-stop", "", t("Stop {drive}", { drive: name }), () => actions.stop(name));
  made.append(make("span", "sign", "■"), ` ${t("STOP")}`);
  return made;
}

/// Only the stop of a drive, for a row of many.
export function buildStop(panel, name, actions) {
  panel.place.classList.add("operate");
  panel.place.replaceChildren(stopButton(name, actions));
  panel.built = true;
}

/// Builds the controls of a drive into the place of the panel.
export function build(panel, name, actions) {
  panel.stop = stopButton(name, actions);
  panel.reset = button("operate-button", t("Reset fault"), t("Reset the fault of {drive}", { drive: name }), () => actions.command(name, { fault_reset: true }, t("Reset")));
  buildQuestion(panel, name, actions);
  buildReference(panel, name, actions);
  panel.result = make("span", "operate-result");
  panel.result.setAttribute("role", "status");
  panel.holder = make("span");
  panel.hold = make("span", "operate-holder", panel.holder, panel.take, panel.release);
  panel.lease = make("span", "operate-lease");
  panel.place.tabIndex = -1;
  panel.place.setAttribute("role", "group");
  panel.place.setAttribute("aria-label", t("Commands of {drive}", { drive: name }));
  panel.place.classList.add("operate");
  // Whatever comes and goes stands below the buttons, which so keep their place.
  panel.place.replaceChildren(panel.stop, make("b", "operate-name", name), make("span", "operate-go", panel.start, panel.turn), panel.reference, panel.reset, panel.question, panel.hold,
    panel.result, panel.lease);
  panel.show = (drive) => {
    const focused = panel.place.contains(document.activeElement) ? document.activeElement : null;
    show(panel, name, drive);
    keepFocus(panel, focused);
  };
  panel.built = true;
}

/// The focus moves from a control that is gone to its successor.
function keepFocus(panel, focused) {
  const isLost = focused && !focused.checkVisibility() && [focused, document.body].includes(document.activeElement);
  if (!isLost || panel.asking) return;
  const holds = [panel.release, panel.take];
  const next = [...(holds.includes(focused) ? holds : []), panel.turn, panel.start, panel.set, panel.place].find((each) => each.checkVisibility());
  next?.focus({ preventScroll: true });
}

/// Who holds the drive, and the ways to take and release it; nothing where drives are not held.
function showHold(panel, drive) {
  text(panel.holder, holdWords(drive));
  hide(panel.take, !mayTake(drive));
  text(panel.take, isHeldByOther(drive) ? t("Take over …") : t("Take"));
  panel.take.setAttribute("aria-label", `${drive.json.name}: ${panel.take.textContent}`);
  hide(panel.release, !isHeldHere(drive));
  hide(panel.hold, !panel.holder.textContent && panel.take.hidden && panel.release.hidden);
}

function show(panel, name, drive) {
  const { json, about } = drive;
  const point = referenceOf(about);
  hide(panel.reference, !point);
  if (point) {
    text(panel.label, point.name === "speed_reference" ? t("Speed reference") : t("Frequency reference"));
    text(panel.unit, unitOf(point.unit));
    text(panel.range, limits(point));
  }
  hide(panel.reset, json.state !== "fault");
  showHold(panel, drive);
  if (panel.asking && panel.restsOn !== restsOn(drive)) return panel.close(t("{drive} has changed", { drive: name }));
  for (const each of [panel.start, panel.turn, panel.take]) each.disabled = Boolean(panel.asking);
  if (panel.asking) return ask(panel, name, drive);
  const runs = json.state === "running";
  hide(panel.start, runs);
  text(panel.start, mayTakeOver(drive) ? t("Take over and start …") : t("Start …"));
  panel.start.setAttribute("aria-label", mayTakeOver(drive) ? `${panel.start.textContent}: ${name}` : t("Start {drive}", { drive: name }));
  hide(panel.turn, !runs || !hasReverse(about));
  text(panel.turn, orderedReverse(json) ? t("Forward …") : t("Reverse …"));
  panel.turn.setAttribute("aria-label", `${name}: ${panel.turn.textContent}`);
}
