"use strict";
// The operating part of the page: the login, and the controls of each drive. Served only with `commands = true`.
//
//   Operate.mount(element, drive)  puts the controls of a drive into an element; `drive` is its name, or its object of
//                                  the JSON interface. Mounting an element again changes nothing.
//   Operate.update(drive)          shows a newer object of /api/v1/drives. To be called for each drive at each update.
//
// The login goes into the element with the id `login`. Without a login, and for drives with access "monitor", a mounted
// element stays empty. Nothing here covers the page: a stop button that is shown can always be pressed.
//
// A lease is renewed only for drives that this login commanded last (the gateway decides that), while the motor runs, the
// page is visible, and somebody used mouse, touch or keyboard within the last ACTIVE_MS.
globalThis.Operate = (() => {
  const ACTIVE_MS = 120000;
  const WARN_MS = 90000;
  const ANSWER_MS = 15000;
  const STOP_ANSWER_MS = 8000;
  const STOP_TRIES = 5;
  const PAUSE_MS = 400;

  const panels = new Map();
  const drives = new Map();
  let session = null;
  let lastActive = performance.now();
  let numbered = 0;
  const page = Array.from(crypto.getRandomValues(new Uint8Array(8)), (byte) => byte.toString(16).padStart(2, "0")).join("");

  function element(tag, className, ...children) {
    const made = document.createElement(tag);
    if (className) made.className = className;
    made.append(...children);
    return made;
  }

  function button(className, words, label, action) {
    const made = element("button", className, words);
    made.type = "button";
    if (label) made.setAttribute("aria-label", label);
    made.addEventListener("click", action);
    return made;
  }

  function say(where, words, good) {
    if (where.textContent !== words) where.textContent = words;
    where.className = `operate-result ${words === "" ? "" : good === null ? "" : good ? "good" : "bad"}`;
  }

  // ---- Requests

  async function post(path, body, ms, abort = new AbortController()) {
    const headers = { "Content-Type": "application/json" };
    if (session) headers["X-CSRF-Token"] = session.csrf;
    const options = { method: "POST", headers, cache: "no-store", signal: abort.signal };
    if (body !== undefined) options.body = JSON.stringify(body);
    const timer = setTimeout(() => abort.abort(), ms);
    try {
      const reply = await fetch(path, options);
      const json = reply.status === 204 ? {} : await reply.json().catch(() => ({}));
      if (reply.status === 401 && session && path !== "api/v1/login") ended();
      return { status: reply.status, json };
    } finally {
      clearTimeout(timer);
    }
  }

  const pathOf = (name, what) => `api/v1/drives/${encodeURIComponent(name)}/${what}`;

  // ---- Login

  const corner = {};

  function buildCorner(place) {
    corner.user = Object.assign(element("input"), { name: "user", autocomplete: "username", required: true, size: 12 });
    corner.password = Object.assign(element("input"), { name: "password", type: "password", autocomplete: "current-password", required: true, size: 12 });
    corner.send = Object.assign(element("button", "operate-button", "Log in"), { type: "submit" });
    corner.form = element("form", "login-form", element("label", "", "User ", corner.user), element("label", "", "Password ", corner.password), corner.send);
    corner.form.addEventListener("submit", (event) => {
      event.preventDefault();
      logIn();
    });
    corner.name = element("b");
    corner.out = button("operate-button", "Log out", "", logOut);
    corner.known = element("span", "login-known", "Logged in as ", corner.name, " ", corner.out);
    corner.note = element("span", "operate-result");
    corner.note.setAttribute("role", "status");
    place.setAttribute("role", "group");
    place.setAttribute("aria-label", "Login");
    place.append(corner.form, corner.known, corner.note);
  }

  function showSession() {
    document.body.classList.toggle("operating", session !== null);
    if (corner.form) {
      corner.form.hidden = session !== null;
      corner.known.hidden = session === null;
      corner.name.textContent = session ? session.user : "";
    }
    for (const name of panels.keys()) show(name);
  }

  async function logIn() {
    corner.send.disabled = true;
    say(corner.note, "Logging in …", null);
    try {
      const { status, json } = await post("api/v1/login", { user: corner.user.value, password: corner.password.value }, 60000);
      if (status === 200) {
        session = json;
        active();
        say(corner.note, "", null);
      } else {
        say(corner.note, json.error || `The gateway answered ${status}.`, false);
      }
    } catch {
      say(corner.note, "The gateway does not answer; nobody was logged in.", false);
    }
    corner.password.value = "";
    corner.send.disabled = false;
    showSession();
    (session ? corner.out : corner.password).focus();
  }

  async function logOut() {
    try {
      await post("api/v1/logout", undefined, 10000);
    } catch {
      say(corner.note, "The gateway does not answer; the session may still be open there.", false);
    }
    forget();
    corner.user.focus();
  }

  function forget() {
    session = null;
    drives.clear();
    showSession();
  }

  function ended() {
    forget();
    if (corner.note) say(corner.note, "The session has ended; what was sent last was not executed. Log in again.", false);
  }

  // ---- Drives

  // What is known of a drive besides its values.
  function known(name) {
    if (!drives.has(name)) drives.set(name, { json: null, about: null, asked: false, ours: false, commanded: -Infinity, renewed: 0, pending: new Set(), stopping: false });
    return drives.get(name);
  }

  async function ask(name) {
    const drive = known(name);
    if (drive.asked || !session) return;
    drive.asked = true;
    try {
      const reply = await fetch(pathOf(name, "commands"), { cache: "no-store", signal: AbortSignal.timeout(10000) });
      if (reply.ok) {
        drive.about = await reply.json();
        drive.ours = drive.ours || drive.about.commanded_last;
      } else if (reply.status === 401) {
        ended();
      }
    } catch {
      // It is asked again below.
    }
    if (!drive.about) setTimeout(() => { drive.asked = false; show(name); }, 3000);
    show(name);
  }

  // The words of a result: what the gateway knows, and nothing more.
  function words(status, json) {
    const ms = (value) => `${Math.round(value)} ms`;
    if (json.result === "confirmed") return `confirmed: the drive shows it, after ${ms(json.confirmed_ms)}`;
    if (json.result === "acknowledged") return `acknowledged by the drive after ${ms(json.latency_ms)}; ${json.note || "no read has shown its effect yet"}`;
    if (json.error && json.error.message) return `${json.error.code.replaceAll("_", " ")}: ${json.error.message}`;
    return json.error || `the gateway answered ${status}`;
  }

  async function command(name, points, what) {
    const drive = known(name);
    const abort = new AbortController();
    drive.pending.add(abort);
    drive.commanded = performance.now();
    tell(name, `${what}: sent …`, null);
    try {
      const { status, json } = await post(pathOf(name, "commands"), { id: `${page}-${++numbered}`, ...points }, ANSWER_MS, abort);
      if (status === 200) drive.ours = true;
      if (!drive.stopping) tell(name, `${what}: ${words(status, json)}`, status === 200);
    } catch {
      if (!drive.stopping) tell(name, `${what}: no answer from the gateway; whether the drive took it is not known`, false);
    }
    drive.pending.delete(abort);
  }

  // A stop waits for nothing, and what waits for an answer gives up its connection to it. While the gateway cannot be
  // reached it is sent again: a stop twice is a stop.
  async function stop(name) {
    const drive = known(name);
    for (const abort of drive.pending) abort.abort();
    if (drive.stopping) return;
    drive.stopping = true;
    tell(name, "Stop: sent …", null);
    for (let tried = 1; session && tried <= STOP_TRIES; tried += 1) {
      try {
        const { status, json } = await post(pathOf(name, "commands"), { id: `${page}-${++numbered}`, run: false }, STOP_ANSWER_MS);
        if (status === 200) drive.ours = true;
        tell(name, `Stop: ${words(status, json)}`, status === 200);
        if (status !== 503 && status !== 504) break;
      } catch {
        const more = tried < STOP_TRIES ? "sending it again" : "it was not sent again";
        tell(name, `Stop: no answer from the gateway, ${more}. Use the stop at the machine.`, false);
      }
      await new Promise((done) => setTimeout(done, PAUSE_MS));
    }
    drive.stopping = false;
  }

  function tell(name, text, good) {
    known(name).result = { text, good };
    show(name);
  }

  // ---- Controls

  function build(panel, name) {
    panel.stop = button("operate-stop", "■ STOP", `Stop ${name}`, () => stop(name));
    panel.start = button("operate-button", "Start …", `Start ${name}`, () => confirming(panel, true));
    panel.really = button("operate-button operate-start", "Start now", `Start now: ${name}`, () => {
      confirming(panel, false);
      command(name, { run: true }, "Start");
    });
    panel.cancel = button("operate-button", "Cancel", `Cancel: do not start ${name}`, () => confirming(panel, false));
    panel.question = element("span", "operate-confirm", `Start ${name}? The motor turns. `, panel.really, panel.cancel);
    panel.question.hidden = true;
    panel.reset = button("operate-button", "Reset fault", `Reset the fault of ${name}`, () => command(name, { fault_reset: true }, "Reset"));
    panel.input = Object.assign(element("input"), { type: "number", step: "any", required: true });
    panel.unit = element("span", "unit");
    panel.range = element("span", "sub");
    panel.label = element("span", "", "Speed reference");
    panel.set = Object.assign(element("button", "operate-button", "Set"), { type: "submit" });
    panel.set.setAttribute("aria-label", `Set the reference of ${name}`);
    panel.reference = element("form", "operate-reference", element("label", "", panel.label, " ", panel.input), panel.unit, panel.set, panel.range);
    panel.reference.hidden = true;
    panel.reference.noValidate = true;
    panel.reference.addEventListener("submit", (event) => {
      event.preventDefault();
      setReference(panel, name);
    });
    panel.result = element("span", "operate-result");
    panel.result.setAttribute("role", "status");
    panel.lease = element("span", "operate-lease");
    panel.place.setAttribute("role", "group");
    panel.place.setAttribute("aria-label", `Commands of ${name}`);
    panel.place.classList.add("operate");
    panel.place.replaceChildren(panel.stop, panel.start, panel.question, panel.reference, panel.reset, panel.result, panel.lease);
    panel.built = true;
  }

  function confirming(panel, asking) {
    panel.question.hidden = !asking;
    panel.start.hidden = asking;
    (asking ? panel.really : panel.start).focus();
  }

  function referenceOf(about) {
    const points = about ? about.points : [];
    return points.find((point) => point.name === "speed_reference") || points.find((point) => point.name === "frequency_reference");
  }

  function setReference(panel, name) {
    const point = referenceOf(known(name).about);
    const value = panel.input.valueAsNumber;
    const { minimum, maximum } = point;
    const outside = (minimum !== null && value < minimum) || (maximum !== null && value > maximum);
    if (Number.isNaN(value) || outside) {
      tell(name, `Reference: write a number${limits(point)}; nothing was sent`, false);
      panel.input.focus();
      return;
    }
    command(name, { [point.name]: value }, `Reference ${value} ${point.unit}`);
  }

  function limits({ minimum, maximum, unit }) {
    if (minimum === null && maximum === null) return "";
    return ` from ${minimum ?? "any"} to ${maximum ?? "any"} ${unit}`;
  }

  function show(name) {
    for (const panel of panels.get(name) || []) {
      const drive = known(name);
      const json = drive.json;
      const usable = session !== null && json !== null && json.access === "control";
      if (!usable && panel.built) {
        panel.place.replaceChildren();
        panel.built = false;
      }
      // An element that never was on the screen has no controls yet: a plant may have a thousand drives.
      if (!usable || !panel.seen) continue;
      if (!panel.built) build(panel, name);
      ask(name);
      const point = referenceOf(drive.about);
      panel.reference.hidden = !point;
      if (point) {
        panel.label.textContent = point.name === "speed_reference" ? "Speed reference" : "Frequency reference";
        panel.unit.textContent = point.unit;
        panel.range.textContent = limits(point).trim();
        panel.input.min = point.minimum ?? "";
        panel.input.max = point.maximum ?? "";
      }
      panel.reset.hidden = json.state !== "fault";
      const { text, good } = drive.result || { text: "", good: null };
      say(panel.result, text, good);
      panel.lease.textContent = leaseWords(drive);
    }
  }

  // ---- Leases

  function active() {
    lastActive = performance.now();
  }

  const idle = () => performance.now() - lastActive;

  function renews(drive) {
    const runs = drive.json && (drive.json.state === "running" || performance.now() - drive.commanded < 10000);
    return session !== null && drive.ours && runs && drive.about && drive.about.lease_ms !== null;
  }

  function leaseWords(drive) {
    if (!renews(drive)) return drive.lost || "";
    if (idle() >= ACTIVE_MS) return "Nobody is active here: its lease is no longer renewed.";
    if (idle() >= WARN_MS) return "Move the mouse or press a key, or its lease is no longer renewed.";
    return "Supervised by this page while you are active.";
  }

  async function renew(name, drive, now) {
    drive.renewed = now;
    drive.lost = "";
    try {
      const { status, json } = await post(pathOf(name, "heartbeat"), undefined, 4000);
      if (status === 409) {
        drive.ours = false;
        drive.lost = `Not supervised by this page: ${json.error}`;
      }
    } catch {
      // The next one may get through; the lease runs out otherwise, as it should.
    }
  }

  setInterval(() => {
    const now = performance.now();
    for (const [name, drive] of drives) {
      if (!renews(drive)) continue;
      const due = now - drive.renewed >= Math.max(250, Math.min(5000, drive.about.lease_ms / 3));
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

  function mount(place, drive) {
    const name = typeof drive === "string" ? drive : drive.name;
    if (place.operatePanel) return;
    const panel = { place, name, seen: false, built: false };
    place.operatePanel = panel;
    panels.set(name, [...(panels.get(name) || []), panel].filter((other) => other === panel || other.place.isConnected));
    screen.observe(place);
    if (typeof drive === "object") update(drive);
  }

  function update(drive) {
    known(drive.name).json = drive;
    if (panels.has(drive.name)) show(drive.name);
  }

  async function begin() {
    const place = document.getElementById("login");
    if (place) buildCorner(place);
    showSession();
    try {
      const reply = await fetch("api/v1/session", { cache: "no-store", signal: AbortSignal.timeout(10000) });
      const json = await reply.json();
      if (json.user && !session) session = json;
    } catch {
      // Nobody is logged in then.
    }
    showSession();
  }

  begin();
  return { mount, update };
})();
