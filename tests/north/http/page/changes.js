"use strict";
// What the page shows when the plant changes under it. Drives a real browser against a gateway that says what the test wants.
const assert = require("node:assert");
const { Browser } = require("./browser.js");
const { FakeGateway, bus, drive, point } = require("./fake_gateway.js");

const shown = (selector) => [...document.querySelectorAll(selector)].filter((element) => element.checkVisibility()).map((element) => element.textContent);
const NASTY = "<img src=x onerror=window.hacked=1>";

async function rowsFollowTheirDrives(gateway, page) {
  const warned = { warning: point(true) };
  gateway.drives = [drive("pump-10"), drive("pump-2"), drive("fan-1", { points: warned }), drive("mixer-1", { state: "fault", fault_text: NASTY, points: { fault_code: point(7) } })];
  await page.open(gateway.url);
  await page.until(() => document.querySelectorAll(".rows .row").length === 4);
  assert.deepEqual(await page.eval(shown, ".rows .name a"), ["mixer-1", "fan-1", "pump-2", "pump-10"], "faults, warnings, then names");
  assert.match((await page.eval(shown, ".row.fault .why"))[0], /F7 <img src=x/);

  // The focus stays on its drive when the order changes.
  await page.eval(() => document.querySelector('.rows a[href="#/drive/pump-10"]').focus());
  gateway.drives[0] = drive("pump-10", { state: "fault", points: { fault_code: point(1) }, fault_text: "overcurrent" });
  await page.until(() => document.querySelector(".rows a").textContent === "mixer-1" && document.querySelectorAll(".rows .fault").length === 2);
  assert.deepEqual(await page.eval(shown, ".rows .name a"), ["mixer-1", "pump-10", "fan-1", "pump-2"]);
  assert.equal(await page.eval(() => document.activeElement.textContent), "pump-10");
  assert.match(await page.eval(() => document.querySelector('.view > [role="status"]').textContent), /pump-10: F1 overcurrent/, "a new fault is announced");

  const speeds = { output_frequency: point(0, { unit: "Hz" }), motor_speed: point(1290, { unit: "rpm", age_ms: 900, contradicted: true }),
    motor_current: point(3.2, { unit: "A", quality: "stale", age_ms: 5000 }), motor_torque: point(null, { unit: "%", quality: "bad", age_ms: null }) };
  gateway.drives = [drive("pump-2", { points: speeds, blocked_by: ["interlocked", "fault"] })];
  await page.until(() => document.querySelectorAll(".rows .row").length === 1);
  const cells = await page.eval(() => [...document.querySelectorAll(".rows .n .value")].map((value) => [value.className, value.textContent, value.title]));
  assert.deepEqual([cells[1], ...cells.slice(3, 6)], [["value main", "0.00", ""], ["value contradicted", "1290", "read 900 ms ago; a newer state says otherwise"],
    ["value stale", "3.2", "stale, 5.0 s old"], ["value bad", "—", "bad: refused by the drive or never read"]]);
  assert.deepEqual(await page.eval(shown, ".rows .blocked"), ["interlocked"]);
}

async function listIsFiltered(gateway, page) {
  gateway.drives = ["a", "b", "c"].map((name, at) => drive(`pump-${name}`, { state: at ? "running" : "offline", bus: at === 2 ? "line2" : "line1" }));
  gateway.buses = [bus("line1"), bus("line2")];
  await page.until(() => document.querySelectorAll(".rows .row").length === 3);
  await page.eval(() => document.getElementById("filter").focus());
  await page.type("PUMP running");
  await page.until(() => document.querySelector(".filter [role=status]").textContent === "2 of 3 drives");
  assert.deepEqual(await page.eval(shown, ".rows .name a"), ["pump-b", "pump-c"]);
  await page.send("Page.reload");
  await page.until(() => document.getElementById("filter")?.value === "PUMP running" && document.querySelectorAll(".rows .row").length === 3);
  assert.deepEqual(await page.eval(shown, ".rows .name a"), ["pump-b", "pump-c"], "the filter is in the address");
  await page.eval(() => [...document.querySelectorAll(".tally a")].find((link) => link.getAttribute("href").includes("line2")).click());
  await page.until(() => document.querySelector(".filter .chip")?.textContent.startsWith("line line2"));
  await page.until(() => document.querySelectorAll(".rows .row:not([hidden])").length === 1);
  assert.deepEqual(await page.eval(shown, ".rows .name a"), ["pump-c"]);
  gateway.buses = [bus("line1")];
}

async function listIsSortedAndGrouped(gateway, page) {
  const current = (value) => ({ motor_current: point(value, { unit: "A" }) });
  gateway.buses = [bus("line2"), bus("line10")];
  gateway.drives = [drive("pump-1", { points: current(4), bus: "line10" }), drive("pump-2", { points: current(12.5), bus: "line2", state: "fault" }), drive("pump-3", { bus: "line2" }),
    drive("pump-10", { points: current(7), bus: "line10" })];
  await page.open(`${gateway.url}#/lines`);
  await page.open(`${gateway.url}#/`);
  await page.until(() => document.querySelectorAll(".rows .row").length === 4);
  const names = () => page.eval(shown, ".rows .name a");
  const sort = (title) => page.eval((title) => [...document.querySelectorAll(".sort")].find((button) => button.textContent === title).click(), title);
  const sorted = () => page.eval(() => [...document.querySelectorAll("[aria-sort]:not([aria-sort=none])")].map((cell) => [cell.textContent, cell.getAttribute("aria-sort")]));
  assert.deepEqual(await names(), ["pump-2", "pump-1", "pump-3", "pump-10"], "faults first");
  await sort("Current");
  assert.deepEqual(await names(), ["pump-2", "pump-10", "pump-1", "pump-3"], "the greatest first, those without one last");
  assert.deepEqual(await sorted(), [["Current", "descending"]]);
  await sort("Current");
  assert.deepEqual(await names(), ["pump-1", "pump-10", "pump-2", "pump-3"]);
  await sort("Drive");
  assert.deepEqual(await names(), ["pump-1", "pump-2", "pump-3", "pump-10"]);
  await page.eval(() => [...document.querySelectorAll(".filter .chip")].find((button) => button.textContent === "By line").click());
  const groups = () => page.eval(() => [...document.querySelectorAll(".rows > *")].filter((element) => element.checkVisibility()).map((element) => element.querySelector("a").textContent));
  assert.deepEqual(await groups(), ["line2", "pump-2", "pump-3", "line10", "pump-1", "pump-10"]);
  await page.send("Page.reload");
  await page.until(() => document.querySelectorAll(".group-row").length === 2 && document.querySelectorAll(".rows .row").length === 4);
  assert.equal(await page.eval("location.hash"), "#/?sort=name&groups=line", "the order is in the address");
  await page.eval(() => document.getElementById("filter").focus());
  await page.type("line2");
  await page.until(() => document.querySelector(".filter [role=status]").textContent === "2 of 4 drives");
  assert.deepEqual(await groups(), ["line2", "pump-2", "pump-3"], "a line without drives has no name here");
  gateway.buses = [bus("line1")];
}

/// What is as new as it should be has no age.
async function agesAreTheException(gateway, page) {
  const points = { motor_current: point(4, { unit: "A", age_ms: 900 }), heatsink_temperature: point(40, { unit: "°C", quality: "stale", age_ms: 5000 }), acceleration_time: point(3, { unit: "s", age_ms: 183741 }) };
  gateway.drives = [drive("pump-1", { points }), drive("pump-2", { points, quality: "stale", age_ms: 5000 })];
  await page.open(`${gateway.url}#/lines`);
  await page.open(`${gateway.url}#/`);
  await page.until(() => document.querySelectorAll(".rows .row").length === 2);
  const ages = () => page.eval(shown, ".row .age:not(:empty), .row .tag");
  assert.deepEqual((await ages()).filter((text) => !text.includes("warning")), ["stale, 5.0 s old", "stale, 5.0 s old"], "of one value, and of a drive");
  await page.open(`${gateway.url}#/drive/pump-1`);
  await page.until(() => document.querySelector(".points div"));
  assert.deepEqual((await page.eval(shown, ".age")).filter(Boolean), ["stale, 5.0 s old", "stale, 5.0 s old"], "among the figures and among the points");
}

async function driveHasALinkOfItsOwn(gateway, page) {
  const odd = "pump 1/ä";
  const stops = [{ kind: "order", passed: true, age_s: 90, due: false }, { kind: "client", passed: false, age_s: 7260, due: true }, { kind: "gateway", passed: null, age_s: null, due: true }];
  const cause = { cause: "interlocked", evidence: "interlocked is on", age_ms: 140, remedy: "close it" };
  const before = { hand_auto: point(false, { text: "hand" }), old_point: point(7), output_frequency: point(25, { unit: "Hz", age_ms: 40 }) };
  gateway.drives = [drive(odd, { points: before, why: [cause], blocked_by: ["interlocked"], stops }), drive("pump-2")];
  gateway.trends = { motor_current: { unit: "A", samples: [[1, 2, 1.5], [1, 3, 2], null, null, null, [4, 4, 4]] } };
  gateway.events = [{ id: 2, boot: 1, time: "2026-03-02T07:40:12.118Z", event: "fault", bus: "line1", drive: odd, text: NASTY, recording: { id: "x" } }];
  await page.open(`${gateway.url}#/`);
  await page.until(() => document.querySelectorAll(".rows .row").length === 2);
  await page.eval(() => document.querySelector(".rows a").click());
  await page.until(() => document.querySelector(".points"));
  const address = await page.eval("location.hash");
  assert.equal(address, "#/drive/pump%201%2F%C3%A4");
  assert.equal(await page.eval(() => document.activeElement.tagName), "H1", "the heading of a new view has the focus");
  // The plot is drawn empty before its samples come.
  await page.until(() => document.querySelector('.points div') && document.querySelector(".curve")?.getAttribute("d"));
  const text = await page.eval("document.querySelector('.view').textContent");
  for (const wanted of [/hand autohand(?!\d)/, /old point7/, /Interlocked|interlocked/, /interlockedAn interlock does not hold\.Make the interlock hold, then press Start\.interlocked is on/, /2 h 1 min/, /Starts3/, /unknown/,
    /a stop command: stopped in time, 1 min ago · a silent client: did not stop in time, 2 h 1 min ago, due · a silent gateway: never tested/]) assert.match(text, wanted);
  assert.deepEqual(await page.eval(() => [...document.querySelectorAll(".curve")].map((path) => path.getAttribute("d").split("M").length - 1)), [2], "a gap is a gap");
  assert.ok(await page.eval(() => document.querySelector('[data-operate]').dataset.operate === "pump 1/ä"));

  // A reload of the configuration gave the drive another profile.
  gateway.drives[0] = drive(odd, { points: { hand_auto: point(true, { text: "auto" }), new_point: point(8) } });
  await page.until(() => document.querySelector(".view").textContent.includes("new point8"));
  const after = await page.eval("document.querySelector('.view').textContent");
  assert.match(after, /hand autoauto/);
  assert.doesNotMatch(after, /old point/, "a point of the profile that was replaced");
  assert.equal(await page.eval(() => document.querySelector(".why-panel").checkVisibility()), false);

  await page.send("Page.reload");
  await page.until(() => document.querySelector("h1")?.textContent === "pump 1/ä" && document.querySelector('.points div'));
  await page.eval("history.back()");
  await page.until(() => document.querySelector("h1").textContent === "Drives" && document.querySelectorAll(".rows .row").length === 2);
  await page.eval("history.forward()");
  await page.until(() => document.querySelector('.points div'));
  gateway.drives = [drive("pump-2")];
  await page.until(() => [...document.querySelectorAll(".problem")].some((problem) => problem.checkVisibility() && problem.textContent.includes("Known: pump-2.")));
  assert.deepEqual(await page.eval(shown, ".view dd"), [], "nothing of a drive that is gone");
  page.problems = page.problems.filter((problem) => !problem.includes("404"));
}

async function cursorIsMovedByKeys(gateway, page) {
  gateway.drives = [drive("pump-2", { points: { motor_current: point(4, { unit: "A" }) } })];
  await page.open(`${gateway.url}#/drive/pump-2`);
  await page.until(() => document.querySelector("h1").textContent === "pump-2" && document.querySelector(".curve"));
  const said = () => [document.querySelector(".cursor").getAttribute("aria-valuetext"), document.querySelector(".plot .reading").textContent];
  await page.until(() => document.querySelector(".plot .reading").textContent === "4.0 A");
  await page.eval(() => document.querySelector(".cursor").focus());
  await page.press("Home");
  const [value, reading] = await page.eval(said);
  assert.match(value, /^\d\d:\d\d:\d\d: Current (1\.5 A|no value)$/);
  assert.match(reading, /1\.5 A|no value/);
  await page.press("ArrowRight");
  await page.press("ArrowRight");
  assert.match((await page.eval(said))[1], /2\.0 A|1\.5 A/);
  await page.press("End");
  assert.deepEqual(await page.eval(said), ["now: Current 4.0 A", "4.0 A"]);
}

async function connectionIsLostAndFound(gateway, page) {
  await page.open(`${gateway.url}#/`);
  await page.until(() => document.querySelector(".rows .row"));
  gateway.silent = true;
  await page.until(() => document.body.classList.contains("lost"));
  const seen = await page.eval(() => [document.getElementById("link-text").textContent, document.getElementById("banner").textContent, getComputedStyle(document.querySelector(".rows .row .state")).filter,
    getComputedStyle(document.querySelector(".rows .value")).textDecorationLine]);
  assert.equal(seen[0], "Connection lost");
  assert.match(seen[1], /^No connection to the gateway since .*\. The data below is out of date/);
  assert.deepEqual(seen.slice(2), ["grayscale(1)", "line-through"]);
  gateway.silent = false;
  await page.until(() => !document.body.classList.contains("lost"));
  assert.equal(await page.eval(() => document.getElementById("banner").checkVisibility()), false);

  // A page that comes back from the background shows nothing old as good, not even until its first answer.
  await page.eval(() => Object.defineProperty(document, "hidden", { configurable: true, get: () => window.away === true }));
  await page.eval(() => {
    window.away = true;
    document.dispatchEvent(new Event("visibilitychange"));
  });
  await new Promise((resolve) => setTimeout(resolve, 4500));
  gateway.silent = true;
  const lost = await page.eval(() => {
    window.away = false;
    document.dispatchEvent(new Event("visibilitychange"));
    return document.body.classList.contains("lost");
  });
  assert.ok(lost);
  gateway.silent = false;
  await page.until(() => !document.body.classList.contains("lost"));
}

async function eventsAreSearched(gateway, page) {
  gateway.events = Array.from({ length: 150 }, (_, at) => ({ id: 150 - at, boot: 1, time: "2026-03-02T07:40:12.118Z", event: at % 50 ? "started" : "fault", bus: "line1", drive: "pump-2", text: `event ${150 - at}` }));
  gateway.events[0].recording = { id: "20260302T074012.118Z-pump-2" };
  await page.open(`${gateway.url}#/events`);
  await page.until(() => document.querySelectorAll(".events li").length === 100);
  assert.equal(await page.eval(() => document.querySelector(".events li a[href^='#/recording']").getAttribute("href")), "#/recording/20260302T074012.118Z-pump-2");
  await page.eval(() => [...document.querySelectorAll(".pages button")].find((button) => button.textContent === "Older").click());
  await page.until(() => document.querySelectorAll(".events li").length === 50);
  await page.eval(() => {
    const select = document.getElementById("event-kind");
    select.value = "fault";
    select.dispatchEvent(new Event("input"));
  });
  await page.until(() => document.querySelectorAll(".events li").length === 3);
  assert.equal(await page.eval("location.hash"), "#/events?kind=fault");
}

async function eventsOfATimeAreSaved(gateway, page) {
  const hour = (n) => new Date(2026, 2, 2, n, 30).toISOString();
  gateway.events = Array.from({ length: 20 }, (_, at) => ({ id: 20 - at, boot: 1, time: hour(20 - at), event: "started", bus: "line1", drive: "pump-2", text: `event "${20 - at}", ${NASTY}` }));
  await page.open(`${gateway.url}#/lines`);
  await page.open(`${gateway.url}#/events`);
  await page.until(() => document.querySelectorAll(".events li").length === 20);
  const choose = (id, value) => {
    const control = document.getElementById(id);
    control.value = value;
    control.dispatchEvent(new Event("input", { bubbles: true }));
  };
  await page.eval(choose, "event-from", "2026-03-02T05:00");
  await page.until(() => document.querySelectorAll(".events li").length === 16);
  await page.eval(choose, "event-to", "2026-03-02T08:00");
  await page.until(() => document.querySelectorAll(".events li").length === 3);
  assert.deepEqual(await page.eval(() => [...document.querySelectorAll(".events .text")].map((each) => each.textContent.slice(0, 9))), ['event "7"', 'event "6"', 'event "5"']);
  assert.equal(await page.eval(() => [...document.querySelectorAll(".pages button")].find((button) => button.textContent === "Older").disabled), true);
  await page.eval(() => {
    const make = URL.createObjectURL;
    URL.createObjectURL = (blob) => {
      window.saved = blob;
      return make.call(URL, blob);
    };
    [...document.querySelectorAll(".pages button")].find((button) => button.textContent === "Save as CSV").click();
  });
  await page.until(() => window.saved);
  const lines = (await page.eval(() => window.saved.text())).split("\r\n");
  assert.deepEqual(lines, ["time,event,bus,drive,text", ...[5, 6, 7].map((n) => `"${hour(n)}","started","line1","pump-2","event ""${n}"", ${NASTY}"`), ""]);
  gateway.events = [];
}

async function linesTellTheirDiagnosis(gateway, page) {
  const seen = () => document.querySelector("#diagnosis-title")?.checkVisibility() && document.querySelector("#diagnosis-title").parentElement.textContent;
  await page.open(`${gateway.url}#/line/line1`);
  await page.until(() => document.querySelector(".strip .count")?.textContent === "4 errors");
  assert.deepEqual(await page.eval(shown, ".histogram dt"), ["1 ms to 2 ms", "2 ms to 5 ms"]);
  assert.match(await page.eval(() => document.querySelector(".minutes").getAttribute("aria-label")), /errors of pump-2: 4 in the last hour, most this minute: 4/);
  assert.ok(!(await page.eval(seen)), "a gateway that makes no diagnosis");
  const verdict = { verdict: "one_drive", drive: "pump-2", certainty: "likely", meaning: "one drive is bad", evidence: NASTY, remedy: "look at its plug", since: "2026-03-02T07:40:12Z" };
  gateway.diagnosis = { bus: "line1", time: "2026-03-02T07:40:12Z", verdicts: [verdict], drives: [] };
  await page.open(`${gateway.url}#/lines`);
  await page.until(() => document.querySelector(".card"));
  await page.open(`${gateway.url}#/line/line1`);
  await page.until(seen);
  // A request from before may be refused after that.
  page.problems = page.problems.filter((problem) => !problem.includes("diagnosis"));
  assert.equal(await page.eval(seen), `Diagnosisone drive pump-2one drive is bad (likely): ${NASTY}look at its plug`);
}

async function rowsKeepTheFocus(gateway, page) {
  const entry = (n) => ({ id: `20260302T07401${n}.118Z-pump-2`, time: `2026-03-02T07:40:1${n}.118Z`, drive: "pump-2", bus: "line1", trigger: "fault", summary: `trip ${n}`, bytes: 1000 });
  const links = () => [...document.querySelectorAll("a[href^='#/recording/']")].map((link) => link.getAttribute("href"));
  gateway.events = [];
  for (const address of ["#/recordings", "#/drive/pump-2"]) {
    gateway.recordings = { a: { entry: entry(1) } };
    await page.open(`${gateway.url}#/lines`);
    await page.open(`${gateway.url}${address}`);
    await page.until(() => document.querySelectorAll("a[href^='#/recording/']").length === 1);
    await page.eval(() => document.querySelector("a[href^='#/recording/']").focus());
    gateway.recordings.b = { entry: entry(2) };
    await page.until(() => document.querySelectorAll("a[href^='#/recording/']").length === 2);
    assert.deepEqual(await page.eval(links), [2, 1].map((n) => `#/recording/${entry(n).id}`), "newest first");
    assert.equal(await page.eval(() => document.activeElement.getAttribute("href")), `#/recording/${entry(1).id}`, `${address}: a new recording takes the focus away`);
    await page.eval(() => [...document.querySelectorAll("td")].find((cell) => cell.textContent === "trip 2").click());
    assert.equal(await page.eval("location.hash"), `#/recording/${entry(2).id}`, `${address}: a recording is opened from anywhere in its row`);
  }
  // The recording that was opened is none of this gateway's.
  await page.until(() => [...document.querySelectorAll(".problem")].some((problem) => problem.checkVisibility()));
  await page.open(`${gateway.url}#/lines`);
  await page.until(() => document.querySelector("h1").textContent === "Lines");
  page.problems = page.problems.filter((problem) => !problem.includes("404"));
  gateway.recordings = {};
}

/// Whether the brokers are reached, and the last packet before one closed the connection.
async function brokersSayWhyTheyAreAway(gateway, page) {
  const said = () => [...document.querySelectorAll(".brokers .card")].map((card) => card.innerText.replace(/\s+/g, " "));
  const link = (more) => ({ client: "mqtt", broker: "broker.example:8883", connected: true, since: "2026-03-02T07:40:12.118Z", error: null, ...more });
  gateway.mqtt = { links: [link(), link({ client: "sparkplug" })], waiting: 0, published: 17, lost: 0 };
  for (const address of ["#/", "#/lines"]) {
    await page.open(`${gateway.url}#/events`);
    // The cards of the view before are not those that are awaited.
    await page.until(() => document.querySelector(".view.events"));
    await page.open(`${gateway.url}${address}`);
    await page.until(() => document.querySelectorAll(".brokers .card").length === 2);
    const [plain, node] = await page.eval(said);
    assert.match(plain, /^MQTT ● connected Broker broker\.example:8883 connected since 2026-03-02 \S+ 0 messages waiting, 17 sent, 0 lost$/);
    assert.match(node, /^Sparkplug ● connected Broker broker\.example:8883 connected since \S+ \S+$/);
  }
  const text = `the broker closed the connection without a reason; the last packet sent before was PUBLISH to ${NASTY} (12 bytes, retained)`;
  gateway.mqtt = { links: [link({ connected: false, error: { time: "2026-03-02T07:41:00.000Z", text } })], waiting: 3, published: 17, lost: 1 };
  await page.until(() => document.querySelector(".brokers .why"));
  const away = (await page.eval(said))[0];
  assert.ok(away.includes("✕ not connected") && away.includes(text) && away.includes("3 messages waiting, 17 sent, 1 lost"), away);
  gateway.mqtt = { links: [], waiting: 0, published: 0, lost: 0 };
  await page.until(() => !document.querySelector(".brokers .card"));
}

/// A magnitude and an arrow, whether a family gives its values a sign or says the direction by a bit alone.
async function everyFamilyHasOneConventionOfSigns(gateway, page) {
  const values = (sign, more) => ({ output_frequency: point(sign * 27.5, { unit: "Hz" }), actual_speed: point(sign * 55, { unit: "%" }), motor_speed: point(sign * 803, { unit: "rpm" }),
    speed_reference: point(55, { unit: "%" }), motor_torque: point(-12.5, { unit: "%" }), ...more });
  const families = { "a-signed": values(-1, { reversed: point(true) }), "b-bit": values(1, { reversed: point(true) }), "c-sign-only": values(-1, {}), "d-forward": values(1, { reversed: point(false) }),
    "e-unknown": values(1, {}), "f-slows": values(-1, { reversed: point(false) }) };
  gateway.drives = Object.entries(families).map(([name, points]) => drive(name, { state: "running", points }));
  await page.open(`${gateway.url}#/lines`);
  await page.open(`${gateway.url}#/`);
  await page.until(() => document.querySelectorAll(".rows .row").length === 6);
  const shownIn = () => [...document.querySelectorAll(".rows .row")].map((row) => [...row.querySelectorAll(".n")].filter((cell) => !cell.hidden).map((cell) => cell.textContent));
  const reverse = ["55.0 % ← reverse", "27.50 Hz ← reverse", "55.0 %", "803 rpm ← reverse", "-12.5 %"];
  const forward = ["55.0 % → forward", "27.50 Hz → forward", "55.0 %", "803 rpm → forward", "-12.5 %"];
  assert.deepEqual(await page.eval(shownIn), [reverse, reverse, reverse, forward, ["55.0 %", "27.50 Hz", "55.0 %", "803 rpm", "-12.5 %"], reverse]);
  gateway.trends = { actual_speed: { unit: "%", samples: [[-55, -55, -55], [-55, -55, -55]] } };
  await page.open(`${gateway.url}#/drive/a-signed`);
  await page.until(() => document.querySelector(".plot .at-aim")?.textContent === "reference now 55.0 %");
  const [line, curve] = await page.eval(() => [document.querySelector(".plot .aim").getBoundingClientRect(), document.querySelector(".plot .curve").getBoundingClientRect()].map(({ y, height }) => y + height / 2));
  assert.ok(Math.abs(line - curve) < 2, "a motor that turns at its reference in reverse is at the line");
  // The past of the reference is a line of steps, in the direction of the speed, and is said at the cursor.
  gateway.trends.speed_reference = { unit: "%", samples: [[20, 20, 20], [55, 55, 55]] };
  await page.open(`${gateway.url}#/lines`);
  await page.open(`${gateway.url}#/drive/a-signed`);
  await page.until(() => document.querySelector(".plot path.aim"));
  const [, first, second] = /^M[\d.]+ ([\d.]+)H[\d.]+V([\d.]+)h0\.1$/.exec(await page.eval(() => document.querySelector(".plot path.aim").getAttribute("d")));
  assert.ok(Number(first) < Number(second), "20 % in reverse is above 55 % in reverse");
  assert.equal(await page.eval(() => document.querySelectorAll(".plot").length), 1, "the reference has no plot of its own");
  await page.until(() => {
    const cursor = document.querySelector(".cursor");
    cursor.value = String(Number(cursor.min) + 1000);
    cursor.dispatchEvent(new Event("input"));
    return document.querySelector(".plot .sub").textContent === "set 20.0 %";
  });
  gateway.trends = { output_frequency: { unit: "Hz", samples: [[-27.5, -27.5, -27.5], [-27.5, -27.5, -27.5], [-27.5, -27.5, -27.5]] } };
  await page.open(`${gateway.url}#/lines`);
  await page.open(`${gateway.url}#/drive/a-signed`);
  await page.until(() => document.querySelector(".plot .reading")?.textContent === "27.50 Hz ←");
  const text = await page.eval(() => [...document.querySelectorAll(".figures dd, .points dd")].map((each) => each.textContent).join("|"));
  assert.match(text, /27\.50 Hz ← reverse/);
  assert.doesNotMatch(text, /-27|-55|-803/);
  await page.eval(() => document.querySelector(".cursor").focus());
  await page.press("ArrowLeft");
  assert.match(await page.eval(() => document.querySelector(".cursor").getAttribute("aria-valuetext")), /Frequency 27\.50 Hz ←/);
  gateway.trends = {};
}

/// Causes, faults and events in the words of an operator, in both languages: nothing that only a program can send.
async function causesAreToldToAnOperator(gateway, first, browser) {
  const causes = ["bus_down", "offline", "stale", "fault", "no_dc_link", "not_ready", "held", "order_refused", "order_expired", "order_unanswered", "other_master", "supervision", "stopped_by_gateway",
    "stopped_by_interlock", "stopped_by_order", "fault_was_reset", "no_run_order", "direction_blocked", "warning", "not_known", "guarded", "interlocked", "reserved", "local_control"];
  const why = causes.map((cause) => ({ cause, evidence: "it is on", age_ms: 10, remedy: cause === "fault" ? "check the cable; then write fault_reset" : "send run again", by: "http alice", result: "not_allowed",
    retry_after_ms: 23400 }));
  const fault = { state: "fault", fault_text: "1", points: { fault_code: point(1) } };
  gateway.events = [{ id: 2, boot: 1, time: "2026-03-02T07:40:12.118Z", event: "fault", bus: "line1", drive: "pump-1", text: "drive pump-1 has fault 1: 1" }];
  const words = {
    "en-US": [/fault 1 \(no text known for this drive\)/, /press Reset fault/, /It may start again in 24 s\./, /It was stopped by http alice\./, /was refused: not allowed\./, /Nobody has started it\.\s+Press Start\./, /check the cable/],
    de: [/Störung 1 \(kein Text für diesen Umrichter bekannt\)/, /dann Störung quittieren drücken/, /Er darf in 24 s wieder starten\./, /Gestoppt von http alice\./, /abgelehnt: nicht erlaubt\./, /Niemand hat ihn gestartet\.\s+Start drücken\./],
  };
  await first.open("about:blank");
  for (const [language, wanted] of Object.entries(words)) {
    gateway.drives = [drive("pump-1", { access: "control", why, blocked_by: causes, holder: "plc", hold_left_s: 9, ...fault })];
    const page = await browser.page({ language });
    await page.open(`${gateway.url}#/drive/pump-1`);
    await page.until((count) => document.querySelectorAll(".causes li").length === count, causes.length);
    await page.until(() => document.querySelector("#live:not([hidden])") && document.querySelector(".events .text"));
    const text = await page.eval("document.querySelector('.view').innerText");
    for (const each of wanted) assert.match(text, each);
    assert.doesNotMatch(text, /send run|fault_reset|\[authority\]|no run order|\{\w+\}|undefined|has fault 1: 1/);
    // A motor that is on at reference 0 does what it is asked to do.
    gateway.drives = [drive("pump-1", { state: "running", why: [{ cause: "reference_zero", evidence: "run is on, and frequency_reference is 0 Hz", age_ms: 10, remedy: "send a reference above zero" }], blocked_by: ["reference_zero"] })];
    const heading = language === "de" ? "Läuft mit 0 %: der Sollwert ist 0" : "Runs at 0 %: the reference is 0";
    await page.until((heading) => document.getElementById("why-title").textContent === heading, heading);
    await page.open(`${gateway.url}#/`);
    await page.until((said) => document.querySelector(".rows .blocked")?.textContent === said, heading[0].toLowerCase() + heading.slice(1));
    await page.close();
  }
  await first.open(`${gateway.url}#/`);
}

/// The language of the browser, its decimals and its units; texts of the gateway stay as they are.
async function pageSpeaksTheLanguageOfTheBrowser(gateway, first, browser) {
  await first.open("about:blank");
  await first.until(() => location.href === "about:blank");
  const page = await browser.page({ language: "de-AT,de,en" });
  gateway.drives = [drive("pump-1", { state: "running", points: { actual_speed: point(62.5, { unit: "%" }), motor_speed: point(1290, { unit: "rpm" }), reversed: point(true) } })];
  gateway.events = [{ id: 2, boot: 1, time: "2026-03-02T07:40:12.118Z", event: "fault_end", bus: "line1", drive: "pump-1", text: "the fault of drive pump-1 is gone" }];
  await page.open(`${gateway.url}#/`);
  // The text of a row is there when it was drawn: `content-visibility`.
  const drawn = () => document.querySelector(".rows .row")?.innerText.includes("62,5");
  await page.until(drawn);
  const text = await page.eval("document.body.innerText");
  for (const wanted of [/Umrichter\nLeitungen\nEreignisse\nAufzeichnungen/, /▶ in Betrieb/, /62,5 %/, /1290 1\/min/, /←\s+rückwärts/, /Störung behoben\nthe fault is gone/]) assert.match(text, wanted);
  assert.equal(await page.eval("document.documentElement.lang"), "de");
  assert.deepEqual(page.problems.filter((problem) => !problem.includes("net::ERR_")), []);
  await page.close();
  // A language that there is not: English, with the decimals of its country.
  const other = await browser.page({ language: "fr-FR" });
  await other.open(`${gateway.url}#/`);
  await other.until(drawn);
  assert.match(await other.eval("document.body.innerText"), /▶ running[^]*62,5 %/);
  assert.equal(await other.eval("document.documentElement.lang"), "en");
  await other.close();
}

async function whatIsChosenIsShownAtOnce(gateway, page) {
  await page.open(`${gateway.url}#/lines`);
  await page.open(`${gateway.url}#/drive/pump-2`);
  await page.until(() => document.querySelector(".curve")?.getAttribute("d"));
  await page.eval(() => {
    const real = window.setTimeout;
    window.waits = [];
    window.setTimeout = (work, wait, ...more) => {
      window.waits.push(wait);
      return real(work, wait, ...more);
    };
  });
  const seen = gateway.asked.length;
  await page.eval(() => [...document.querySelectorAll(".chip")].find((button) => button.textContent === "1 h").click());
  await page.until(() => window.waits.includes(50));
  await page.until(() => document.querySelector('.chip[aria-pressed="true"]').textContent === "1 h" && document.querySelector(".curve")?.getAttribute("d"));
  assert.ok(gateway.asked.slice(seen).some((address) => address.includes("from=1h")), "the trends of an hour were asked for");
}

async function main() {
  const gateway = new FakeGateway();
  gateway.url = await gateway.start();
  const browser = new Browser();
  const page = await browser.page();
  for (const step of [rowsFollowTheirDrives, listIsFiltered, listIsSortedAndGrouped, agesAreTheException, driveHasALinkOfItsOwn, cursorIsMovedByKeys, connectionIsLostAndFound, eventsAreSearched, eventsOfATimeAreSaved, linesTellTheirDiagnosis,
    rowsKeepTheFocus, whatIsChosenIsShownAtOnce, brokersSayWhyTheyAreAway, everyFamilyHasOneConventionOfSigns, causesAreToldToAnOperator, pageSpeaksTheLanguageOfTheBrowser]) {
    try {
      await step(gateway, page, browser);
    } catch (error) {
      throw new Error(`${step.name}: ${error.stack}`);
    }
    // Requests that were cut off are what the step is about.
    const problems = page.problems.filter((problem) => !/net::ERR_|cannot read the gateway/.test(problem));
    assert.deepEqual(problems, [], step.name);
    assert.equal(await page.eval("window.hacked"), undefined, `${step.name}: a text became markup`);
  }
  await browser.close();
  await gateway.stop();
}

main().catch((error) => {
  console.error(error);
  process.exit(1);
});
