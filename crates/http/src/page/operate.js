// The operating part of the page: the controls of each drive. Served only with `commands = true`.
//
//   Operate.mount(element, drive)  puts the controls of a drive into an element; `drive` is its name, or its object of
//                                  the JSON interface. Mounting an element again changes nothing.
//   Operate.mount(element, drive, notice)  puts only its stop there; `notice` is an element for what came of it.
//   Operate.update(drive)          shows a newer object of /api/v1/drives. To be called for each drive at each update.
//
// Without a login, and for drives with access "monitor", a mounted element stays empty. A lease is renewed only for drives that this
// login commanded last (the gateway decides that), while the motor runs, the page is visible, and somebody used mouse, touch or
// keyboard within the last ACTIVE_MS.

import { refusalText } from "./causes.js";
import { clock, hint, text } from "./common.js";
import { build, buildStop } from "./controls.js";
import { stopPressed } from "./questions.js";
import { check, isLoggedIn, onSession, post } from "./session.js";
import { onStopAll } from "./stop_all.js";
import { notStopped, stopped } from "./stops.js";
import { t, wordsOf } from "./texts.js";

const ACTIVE_MS = 120000;
// A hold is renewed as a lease of that time.
const KEPT_MS = 15000;
const WARN_MS = 90000;
const ANSWER_MS = 15000;
const STOP_ANSWER_MS = 8000;
// A stop without an answer is sent again for that long, with a pause between two tries.
const STOP_MS = 30000;
const PAUSE_MS = 1000;
// A row of the overview says for that long what came of a command.
const NOTICE_MS = 20000;

const panels = new Map();
const drives = new Map();
let lastActive = performance.now();
let numbered = 0;
const page = Array.from(crypto.getRandomValues(new Uint8Array(8)), (byte) => byte.toString(16).padStart(2, "0")).join("");

// What is known of a drive besides its values.
function known(name) {
  if (!drives.has(name)) drives.set(name, { json: null, about: null, asked: false, ours: false, kept: false, commanded: -Infinity, renewed: 0, pending: new Set(), stopping: false });
  return drives.get(name);
}

const pathOf = (name, what) => `api/v1/drives/${encodeURIComponent(name)}/${what}`;

const send = (name, points, ms, abort) => post(pathOf(name, "commands"), { id: `${page}-${++numbered}`, ...points }, ms, abort);

async function ask(name) {
  const drive = known(name);
  if (drive.asked || !isLoggedIn()) return;
  drive.asked = true;
  try {
    const reply = await fetch(pathOf(name, "commands"), { cache: "no-store", signal: AbortSignal.timeout(10000) });
    if (reply.ok) {
      drive.about = await reply.json();
      drive.ours = drive.ours || drive.about.commanded_last;
    } else if (reply.status === 401) {
      await check();
    }
  } catch {
    // It is asked again below.
  }
  if (!drive.about) setTimeout(() => { drive.asked = false; show(name); }, 3000);
  show(name);
}

// ---- Commands

// The words of a result: what the gateway knows, and nothing more.
function words(status, json, about) {
  const ms = (value) => `${Math.round(value)} ms`;
  if (json.result === "confirmed") return t("confirmed: the drive shows the effect, after {time}", { time: ms(json.confirmed_ms) });
  if (json.result === "acknowledged") return t("acknowledged by the drive after {time}", { time: ms(json.latency_ms) }) + `; ${json.note || t("no read has shown the effect yet")}`;
  const refusal = json.error?.code && refusalText(json, about);
  if (refusal) return refusal;
  if (json.error && json.error.message) return `${wordsOf(json.error.code)}: ${json.error.message}`;
  return json.error || t("The gateway replied {status}.", { status });
}

// A start takes the drive first, where somebody may hold it, and takes it over where that was asked.
async function take(name, takesOver, abort) {
  const drive = known(name);
  if (drive.json?.hold === undefined) return null;
  const act = (action) => post(pathOf(name, "hold"), { action }, ANSWER_MS, abort);
  const taken = await act("take");
  const over = taken.status === 409 && takesOver ? await act("break") : taken;
  return over.status === 200 ? null : over;
}

async function command(name, points, what, takesOver = false) {
  const drive = known(name);
  const abort = new AbortController();
  drive.pending.add(abort);
  drive.commanded = performance.now();
  tell(name, t("{what}: sent …", { what }), null);
  try {
    const refused = points.run === true ? await take(name, takesOver, abort) : null;
    if (refused !== null || abort.signal.aborted) {
      if (refused !== null && !drive.stopping) tell(name, `${what}: ${words(refused.status, refused.json, drive.about)}`, false);
      drive.pending.delete(abort);
      return;
    }
    const { status, json } = await send(name, points, ANSWER_MS, abort);
    if (status === 200) drive.ours = true;
    if (!drive.stopping) tell(name, `${what}: ${words(status, json, drive.about)}`, status === 200);
  } catch {
    if (!drive.stopping) tell(name, t("{what}: no reply from the gateway; it is unknown whether the drive executed it", { what }), false);
  }
  drive.pending.delete(abort);
}

/// Takes, takes over (`break`) or releases the drive; the motor goes on as it is.
async function hold(name, action, what) {
  const drive = known(name);
  tell(name, t("{what}: sent …", { what }), null);
  try {
    const { status, json } = await post(pathOf(name, "hold"), { action }, ANSWER_MS);
    if (status === 200) drive.kept = action !== "release";
    if (!drive.stopping) tell(name, `${what}: ${status === 200 ? t("done") : words(status, json, drive.about)}`, status === 200);
  } catch {
    if (!drive.stopping) tell(name, `${what}: ${t("The gateway does not respond.")}`, false);
  }
}

// Of these nobody knows whether the drive took it; of the others it is known that it did not.
const UNKNOWN = [502, 504];
const AGAIN = [503, 504];

/// How one try of a stop ended: `stopped`, `refused` or `unknown`, in words, and whether another may do better.
async function tryStop(name) {
  try {
    const { status, json } = await send(name, { run: false }, STOP_ANSWER_MS);
    if (status === 200) return { certainty: "stopped", why: words(status, json) };
    return { certainty: UNKNOWN.includes(status) ? "unknown" : "refused", why: words(status, json), again: AGAIN.includes(status), login: status === 401 || status === 403 };
  } catch {
    return { certainty: "unknown", why: t("The gateway does not respond."), again: true };
  }
}

function giveUp(drive) {
  for (const abort of drive.pending) abort.abort();
}

// A start that takes the drive first is not sent behind a stop of all drives.
onStopAll(() => drives.forEach(giveUp));

// A stop waits for nothing, and what waits for an answer gives up its connection to it. While the gateway cannot be
// reached it is sent again: a stop twice is a stop.
async function stop(name) {
  const drive = known(name);
  giveUp(drive);
  stopPressed();
  if (drive.stopping) return;
  drive.stopping = true;
  tell(name, t("{what}: sent …", { what: t("Stop") }), null);
  const [begun, from] = [performance.now(), clock(new Date())];
  // A try that nobody answered may have reached the drive, whatever is said to a later one.
  let certainty = "refused";
  for (let count = 1; ; count += 1) {
    const ended = await tryStop(name);
    if (ended.certainty === "stopped") {
      drive.ours = true;
      tell(name, `${t("Stop")}: ${ended.why}`, true);
      stopped(name, ended.why);
      break;
    }
    tell(name, `${t("Stop")}: ${ended.why}`, false);
    // The login was renewed in another tab: its session may stop, too.
    if (ended.login) await check();
    const renewed = ended.login && count === 1 && isLoggedIn();
    const again = ended.again && performance.now() - begun < STOP_MS && isLoggedIn();
    if (renewed) continue;
    if (ended.certainty === "unknown") certainty = "unknown";
    notStopped(name, certainty, sentence(ended.why), tries(count, from, again));
    if (!again) break;
    await new Promise((done) => setTimeout(done, PAUSE_MS));
  }
  drive.stopping = false;
}

const sentence = (words) => `${words[0].toUpperCase()}${words.slice(1)}`.replace(/[^.!?]$/, "$&.");

function tries(count, from, again) {
  if (again) return t("Sent {count} times since {from}; it is being sent again.", { count, from });
  if (count === 1) return t("Sent once, at {from}; it is not sent again.", { from });
  return t("Sent {count} times from {from} to {to}; it is not sent again.", { count, from, to: clock(new Date()) });
}

function tell(name, words, good) {
  known(name).result = { words, good, at: performance.now() };
  show(name);
}

// ---- What is shown

const actions = { command, hold, stop, tell, known };

function show(name) {
  for (const panel of panels.get(name) || []) {
    const drive = known(name);
    const usable = isLoggedIn() && drive.json !== null && drive.json.access === "control";
    if (!usable && panel.built) {
      panel.place.replaceChildren();
      if (panel.notice) text(panel.notice, "");
      panel.built = false;
    }
    // An element that never was on the screen has no controls yet: a plant may have a thousand drives.
    if (!usable || !panel.seen) continue;
    if (!panel.built && panel.notice) buildStop(panel, name, actions);
    else if (!panel.built) build(panel, name, actions);
    ask(name);
    if (panel.notice) {
      showNotice(panel.notice, drive);
      continue;
    }
    panel.show(drive);
    const { words, good } = drive.result || { words: "", good: null };
    text(panel.result, words);
    panel.result.className = `operate-result ${words === "" || good === null ? "" : good ? "good" : "bad"}`;
    text(panel.lease, leaseWords(drive));
  }
}

function showNotice(element, drive) {
  const { words, good, at } = drive.result ?? {};
  const isNew = Boolean(words) && performance.now() - at < NOTICE_MS;
  text(element, isNew ? words : leaseWarning(drive));
  hint(element, element.textContent);
  element.className = `notice ${isNew && good !== false ? "" : "bad"}`;
}

onSession(() => {
  if (!isLoggedIn()) {
    for (const drive of drives.values()) Object.assign(drive, { about: null, asked: false, ours: false, kept: false, result: null });
  }
  for (const name of panels.keys()) show(name);
});

// ---- Leases

// Something that lies on a key is nobody.
function active({ repeat }) {
  if (!repeat) lastActive = performance.now();
}

const idle = () => performance.now() - lastActive;

function supervises(drive) {
  const runs = drive.json && (drive.json.state === "running" || performance.now() - drive.commanded < 10000);
  return isLoggedIn() && drive.ours && runs && drive.about && drive.about.lease_ms !== null;
}

/// A drive that was taken here is kept while somebody is active.
const keeps = ({ kept, json, about }) => isLoggedIn() && kept && json?.hold === "held" && about && json.holder === about.principal;

const renews = (drive) => supervises(drive) || keeps(drive);

function leaseWarning(drive) {
  if (!renews(drive)) return drive.lost || "";
  if (idle() >= ACTIVE_MS) return t("No activity here: its lease is no longer renewed.");
  return idle() >= WARN_MS ? t("Move the mouse or press a key, or its lease is no longer renewed.") : "";
}

function leaseWords(drive) {
  if (supervises(drive)) return leaseWarning(drive) || t("Supervised by this page while you are active.");
  return leaseWarning(drive) || (keeps(drive) ? t("Kept by this page while you are active.") : "");
}

async function renew(name, drive, now) {
  drive.renewed = now;
  drive.lost = "";
  try {
    const { status, json } = await post(pathOf(name, "heartbeat"), undefined, 4000);
    if (status === 409) {
      drive.ours = false;
      drive.lost = t("Not supervised by this page: {why}", { why: json.error });
    }
  } catch {
    // The next one may get through; the lease runs out otherwise, as it should.
  }
}

setInterval(() => {
  const now = performance.now();
  for (const [name, drive] of drives) {
    if (!renews(drive)) continue;
    const due = now - drive.renewed >= Math.max(250, Math.min(5000, (drive.about.lease_ms ?? KEPT_MS) / 3));
    if (due && !document.hidden && idle() < ACTIVE_MS) renew(name, drive, now);
    show(name);
  }
}, 250);

for (const kind of ["pointerdown", "pointermove", "keydown", "wheel", "touchstart"]) {
  addEventListener(kind, active, { passive: true });
}

const screen = new IntersectionObserver((entries) => {
  for (const entry of entries) {
    const panel = entry.target.operatePanel;
    if (!entry.isIntersecting) continue;
    panel.seen = true;
    screen.unobserve(entry.target);
    show(panel.name);
  }
}, { rootMargin: "200px" });

function mount(place, drive, notice = null) {
  const name = typeof drive === "string" ? drive : drive.name;
  if (place.operatePanel) return;
  const panel = { place, name, notice, seen: false, built: false };
  place.operatePanel = panel;
  panels.set(name, [...(panels.get(name) || []), panel].filter((other) => other === panel || other.place.isConnected));
  screen.observe(place);
  if (typeof drive === "object") update(drive);
}

function update(drive) {
  known(drive.name).json = drive;
  if (panels.has(drive.name)) show(drive.name);
}

globalThis.Operate = { mount, update };
