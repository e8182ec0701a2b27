// Why a drive does not run, and why a command was refused, in the words of an operator: what is the matter, and what to press or to look at.
// The gateway's own texts are for programs; where they carry what a manual or a configuration says, they are shown as well, in English.

import { words } from "./common.js";
import { t } from "./texts.js";

const START = t("Press Start.");
const AGAIN = t("Press Start again.");

// Each cause in a few words, in a sentence, and what to do.
const CAUSES = {
  bus_down: [t("line down"), t("The line has no connection."), t("Check the adapter and its cable.")],
  offline: [t("offline"), t("The drive does not answer."), t("Check its power supply, wiring and address.")],
  stale: [t("values too old"), t("Its values are too old."), t("The line may be overloaded or disturbed: see its diagnosis.")],
  no_dc_link: [t("no DC link voltage"), t("Its DC link is not charged."), t("Switch the mains on; check fuses and contactor.")],
  not_ready: [t("not ready"), t("It is not ready and does not say why."), t("Check its enable and interlock inputs and its display.")],
  held: [t("parameters restored"), t("Its parameters are being restored, or a restore was interrupted."), t("Wait until the restore ends.")],
  order_refused: [t("start refused"), t("The last start was refused."), t("Remove the cause, then press Start again.")],
  order_expired: [t("start not sent"), t("The last start was not sent: the line was busy or down."), AGAIN],
  order_unanswered: [t("start not acknowledged"), t("The drive did not acknowledge the last start."), t("Check whether the drive answers, then press Start again.")],
  other_master: [t("another controller"), t("Its run command went off, and nobody here stopped it."), t("Look for another controller; if the drive was restarted, press Start again.")],
  supervision: [t("supervision stopped it"), t("It was stopped because nobody supervised it any more."), t("Press Start again and stay active here, or let a controller supervise it.")],
  stopped_by_gateway: [t("gateway stopped it"), t("The gateway stopped it: at its own end, or when the panel took over."), START],
  stopped_by_interlock: [t("interlock stopped it"), t("An interlock stopped it."), t("Make the interlock hold, then press Start.")],
  stopped_by_order: [t("stopped"), t("It was stopped by {who}."), t("Press Start if it may run.")],
  fault_was_reset: [t("fault was reset"), t("Its fault was reset by {who}, which starts nothing."), START],
  no_run_order: [t("not started"), t("Nobody has started it."), START],
  reference_zero: [t("reference is 0"), t("Its reference is 0."), t("Set a reference above 0.")],
  direction_blocked: [t("reverse blocked"), t("It is to turn in reverse and does not."), t("Choose forward, or allow reverse in its parameters.")],
  warning: [t("warning"), t("The drive has a warning."), t("Read it at the display of the drive.")],
  not_known: [t("cause unknown"), t("Nothing that the drive reports keeps it from running."), t("Look at its display.")],
  guarded: [t("start must wait"), t("The motor may not start yet."), t("It may start again in {time}.")],
  interlocked: [t("interlocked"), t("An interlock does not hold."), t("Make the interlock hold, then press Start.")],
  reserved: [t("reserved after a stop"), t("It was stopped by {holder}, who keeps it for another {left} s."), t("Wait, or let {holder} release it.")],
  local_control: [t("local control"), t("Its panel or its terminals control it."), t("Select the fieldbus as control place at the drive.")],
  inhibited: [t("start inhibited"), t("An input of the drive inhibits the start."), t("Close the enable input of the drive.")],
  undervoltage: [t("undervoltage"), t("Its supply voltage is too low."), t("Check the mains and its fuses.")],
  bypass: [t("bypass"), t("The motor runs past the drive, at the mains."), t("End the bypass at its switch.")],
  fire_mode: [t("fire mode"), t("Fire mode is active; it obeys no other command."), t("End fire mode at the input of the drive.")],
  hand_off_auto: [t("hand-off-auto"), t("Its hand-off-auto switch does not stand at automatic."), t("Turn the switch to automatic.")],
  baseblock: [t("output blocked"), t("Its output is blocked by an input."), t("Open the input that blocks the output.")],
  reference_missing: [t("reference missing"), t("The drive misses its reference."), t("Check the source of its reference.")],
  external_fault: [t("external fault"), t("An input reports an external fault."), t("Look at the device at this input.")],
  coast_stop: [t("coast stop"), t("A coast stop is active."), t("End it where it was given: an input or another controller.")],
  emergency_stop: [t("emergency stop"), t("An emergency stop is active."), t("Release it at the machine once it is safe.")],
  quick_stop: [t("quick stop"), t("A quick stop is active."), t("End it where it was given: an input or another controller.")],
  trip_lock: [t("trip lock"), t("It tripped and is locked."), t("Switch its supply off and on again.")],
};

// Causes whose evidence says what no text of the page can: a manual's words, a name of the configuration, an error of the machine.
const EVIDENT = ["bus_down", "held", "interlocked", "fault"];

const seconds = (ms) => `${Math.ceil(ms / 1000)} s`;

/// The name of a cause in a few words.
export const causeWord = (cause) => CAUSES[cause]?.[0] ?? words(cause);

// `http alice 10.0.0.7`: the way in, in the language of the page, and who.
function giver(by) {
  const [source, ...rest] = (by ?? "").split(" ");
  return by ? [words(source), ...rest].join(" ") : t("somebody");
}

function faultText(cause, fault) {
  const [manual, reset] = cause.remedy.split(/(?:^|; )then (?=write fault_reset|reset the drive)/);
  const press = reset === "write fault_reset" ? t("Remove the cause, then press Reset fault.") : t("Remove the cause, then reset the drive at its panel.");
  return { name: t("fault"), said: fault || t("A fault is active; its code is not known."), todo: press, evidence: [cause.evidence, manual].filter(Boolean).join("; ") };
}

/// A cause for an operator: its name, what is the matter, what to do, and what the gateway adds in English. `fault`: that of the drive in words.
export function causeText(cause, drive, fault) {
  if (cause.cause === "fault") return faultText(cause, fault);
  const known = CAUSES[cause.cause];
  // A cause that only a custom profile names has the texts of that profile.
  if (!known) return { name: words(cause.cause), said: "", todo: "", evidence: [cause.evidence, cause.remedy].filter(Boolean).join("; ") };
  const values = { who: giver(cause.by), holder: drive.holder, left: drive.hold_left_s, time: seconds(cause.retry_after_ms ?? 0) };
  const fill = (text) => text.replace(/\{(\w+)\}/g, (hole, name) => values[name] ?? hole);
  let [name, said, todo] = known;
  if (cause.cause === "order_refused" && cause.result) said = t("The last start was refused: {reason}.", { reason: words(cause.result) });
  if (cause.cause === "no_run_order" && drive.access !== "control") todo = t("Its own controller must start it: this gateway only reads it.");
  if (cause.cause === "guarded" && !cause.retry_after_ms) todo = "";
  return { name, said: fill(said), todo: fill(todo), evidence: EVIDENT.includes(cause.cause) ? cause.evidence : "" };
}

/// What keeps a drive from turning, in a few words; a fault and being offline are said elsewhere.
export function blockedOf(drive) {
  if (drive.state === "running" && drive.blocked_by.includes("reference_zero")) return t("runs at 0 %: the reference is 0");
  return drive.blocked_by.filter((word) => word !== "fault" && word !== "offline").map(causeWord).join(", ");
}

/// The heading above the causes. A motor that is on at reference 0 does what it is asked to do.
export function causesTitle(drive) {
  if (drive.state !== "running") return t("Why it does not run");
  return drive.why.some(({ cause }) => cause === "reference_zero") ? t("Runs at 0 %: the reference is 0") : t("It is on and does not turn");
}

/// Why a command was refused; nothing where only the gateway can say it. `about`: what the login may do with the drive.
export function refusalText({ error, holder, holder_rank: rank, hold_left_s: left, retry_after_ms: wait }, about) {
  switch (error.code) {
    case "held_by_other":
      return rank === "local" ? t("its panel or its terminals control it") : t("held by {holder} ({rank}), {left} s left", { holder, rank, left: left ?? "?" });
    case "needs_take":
      return t("{holder} stopped it: take it first", { holder });
    case "guarded":
      return wait ? t("the motor may start again in {time}", { time: seconds(wait) }) : t("the motor may not start yet");
    case "interlocked":
      return `${t("an interlock does not hold")} (${error.message})`;
    case "not_allowed":
      return about && about.principal === null && about.outranks === null && error.message.includes("principal") ? t("this login may only stop it") : "";
    case "offline":
    case "timeout":
      return t("the drive does not answer");
    case "expired":
      return t("not sent: the line was busy");
    default:
      return "";
  }
}
