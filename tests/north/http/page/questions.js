"use strict";
// What the page asks before it sends: a key that is held answers nothing, and a question ends when what it rests on changes. Drives a
// real browser against a gateway that says what the test wants.
const assert = require("node:assert");
const { STOP, click, opened, plant, run, shown, told } = require("./operated.js");
const { point } = require("./fake_gateway.js");

const START = "button[aria-label='Start pump-1']";
const TURN = "button[aria-label='pump-1: Reverse …']";
const NOW = { [START]: "button[aria-label='Start now: pump-1']", [TURN]: "button[aria-label='Change direction now: pump-1']" };
const ALL = "#stop-all";
const RUNS = { state: "running" };
const DRIVE = "#/drive/pump-1";

const focus = (selector) => document.querySelector(selector).focus();
const focused = (selector) => document.activeElement.matches(selector);
const isAsked = () => Boolean(document.querySelector(".operate-confirm:not([hidden])")?.checkVisibility());
const isNotAsked = () => ![...document.querySelectorAll(".operate-confirm")].some((question) => question.checkVisibility());
const stopAllAsks = () => document.querySelector("#stops .operate-stop")?.checkVisibility() ?? false;

async function asked(gateway, page, what) {
  await opened(gateway, page, DRIVE, what === TURN ? RUNS : {});
  await page.until(shown, ".operate-reference");
  await page.until(shown, what);
  await page.eval(click, what);
  assert.equal(await page.eval(isAsked), true);
}

/// The key is held, as keyboards repeat it and as those do that say nothing of it.
async function hold(page, key) {
  await page.keyDown(key);
  for (let count = 0; count < 5; count += 1) await page.keyDown(key, true);
  for (let count = 0; count < 5; count += 1) await page.keyDown(key);
  for (let count = 0; count < 5; count += 1) await page.keyDown(key, true);
}

async function aKeyThatIsHeldAnswersNothing(gateway, page) {
  for (const [what, order] of [[START, { run: true, reverse: false }], [TURN, { reverse: true }]]) {
    await opened(gateway, page, DRIVE, what === TURN ? RUNS : {});
    await page.until(shown, ".operate-reference");
    await page.until(shown, what);
    for (const key of ["Enter", " "]) {
      await page.eval(focus, what);
      await hold(page, key);
      await page.keyUp(key);
      assert.equal(await page.eval(isAsked), true, `${what} by ${key}`);
      assert.deepEqual(gateway.commands, [], `${what} by ${key}`);
      await page.press("Escape");
    }
    await page.eval(focus, what);
    await hold(page, "Enter");
    await page.keyUp("Enter");
    // Another key, or the same once more, is an answer.
    await page.press("Enter");
    await page.until(told, "confirmed");
    assert.deepEqual(gateway.commands, [order], what);
  }
  // One that was released where the page did not see it.
  await asked(gateway, page, START);
  await page.press("Escape");
  await page.eval(focus, START);
  await page.keyDown("Enter");
  await page.eval(() => window.dispatchEvent(new Event("blur")));
  await page.press("Enter");
  await page.until(told, "confirmed");
}

async function aKeyThatIsHeldPressesNothingTwice(gateway, page) {
  await opened(gateway, page, DRIVE);
  await page.eval(focus, ALL);
  await hold(page, "Enter");
  await page.keyUp("Enter");
  assert.equal(await page.eval(stopAllAsks), true);
  assert.deepEqual(gateway.commands, []);
  await page.press("Enter");
  await page.until(() => document.querySelector("#stops p").textContent.includes("replied"));
  assert.deepEqual(gateway.commands, [{}], "all are stopped");
  // A reference is sent once.
  plant(gateway);
  await page.until(shown, ".operate-reference");
  await page.eval(focus, ".operate-reference input");
  await page.type("5");
  await page.keyDown("Enter");
  for (let count = 0; count < 10; count += 1) await page.keyDown("Enter", true);
  await page.keyUp("Enter");
  await page.until(told, "Reference 5 %: confirmed");
  assert.deepEqual(gateway.commands, [{ speed_reference: 5 }]);
}

async function escapeClosesEveryQuestion(gateway, page) {
  for (const what of [START, TURN]) {
    for (const elsewhere of [false, true]) {
      await asked(gateway, page, what);
      if (elsewhere) await page.eval(() => document.activeElement.blur());
      await page.press("Escape");
      assert.equal(await page.eval(isNotAsked), true, what);
      if (!elsewhere) assert.equal(await page.eval(focused, what), true, "the focus goes back");
    }
  }
  for (const elsewhere of [false, true]) {
    await page.eval(click, ALL);
    assert.equal(await page.eval(stopAllAsks), true);
    if (elsewhere) await page.eval(() => document.activeElement.blur());
    await page.press("Escape");
    assert.equal(await page.eval(stopAllAsks), false);
  }
  assert.deepEqual(gateway.commands, []);
}

async function anyStopClosesQuestions(gateway, page) {
  const stops = {
    "its own": (page) => page.eval(click, STOP),
    "that of all drives": (page) => page.eval(click, ALL),
  };
  for (const [whose, press] of Object.entries(stops)) {
    for (const what of [START, TURN]) {
      await asked(gateway, page, what);
      await press(page);
      assert.equal(await page.eval(isNotAsked), true, `${what} and ${whose}`);
      // What was about to be pressed is not pressed.
      await page.press("Enter");
      await page.eval(() => new Promise((done) => setTimeout(done, 100)));
      assert.ok(gateway.commands.every(({ run, reverse }) => run !== true && reverse === undefined), JSON.stringify(gateway.commands));
    }
  }
  // The question whether to stop all is no start: a stop leaves it.
  await opened(gateway, page, DRIVE);
  await page.eval(click, ALL);
  await page.eval(click, STOP);
  assert.equal(await page.eval(stopAllAsks), true);
}

/// A start that takes the drive first is not sent behind a stop of all drives.
async function aStartThatIsUnderWayEndsWithAStopOfAll(gateway, page) {
  await opened(gateway, page, DRIVE, { hold: "free", holder: null, holder_rank: null, hold_left_s: 0 });
  await page.until(shown, ".operate-reference");
  let taken;
  gateway.wait = new Promise((resolve) => (taken = resolve));
  await page.eval(click, START);
  await page.eval(click, NOW[START]);
  await page.until(() => document.querySelector(".operate .operate-result").textContent.includes("sent"));
  await page.eval(click, ALL);
  await page.eval(click, "#stops .operate-stop");
  gateway.wait = null;
  taken();
  await page.eval(() => new Promise((done) => setTimeout(done, 300)));
  assert.ok(gateway.commands.every(({ run }) => run !== true), JSON.stringify(gateway.commands));
}

async function aChangeClosesQuestions(gateway, page) {
  const reversed = { reverse: point(true) };
  const by = (cause, evidence) => ({ why: [{ cause, evidence, age_ms: 10, remedy: "" }] });
  const changes = [[START, "it starts", RUNS], [START, "it faults", { state: "fault" }], [START, "it is offline", { state: "offline", online: false }],
    [START, "it is not ready", { state: "not_ready" }], [START, "its state is not known", { state: null }], [START, "another holds it", { hold: "held", holder: "plc", holder_rank: "automation" }],
    [START, "it is reserved", { hold: "reserved", holder: "bob" }], [START, "its panel commands it", { hold: "local" }], [START, "its parameters are restored", { held: "a restore is under way" }],
    [START, "it started and was stopped", { starts: 4 }], [START, "another stopped it", by("stopped_by_order", "http bob stopped it")], [START, "a lease ended", by("supervision", "its lease expired")],
    [START, "another direction is ordered", { reversed }], [START, "the name means another machine", { address: 7 }], [START, "it is only monitored", { access: "monitor" }],
    [TURN, "it stops", { state: "ready" }], [TURN, "it faults", { state: "fault" }], [TURN, "it is offline", { state: "offline", online: false }], [TURN, "it was started again", { starts: 4 }],
    [TURN, "another one turned it", { reversed }], [TURN, "another holds it", { hold: "held", holder: "plc", holder_rank: "automation" }]];
  for (const [what, why, change] of changes) {
    await asked(gateway, page, what);
    const { reversed, ...rest } = change;
    Object.assign(gateway.drives[0], rest);
    Object.assign(gateway.drives[0].points, reversed);
    await page.until(isNotAsked);
    if (change.access === undefined) await page.until(told, "nothing was sent, pump-1 has changed");
    // What is pressed too late meets no control.
    await page.press("Enter");
    await page.eval(() => new Promise((done) => setTimeout(done, 50)));
    assert.equal(await page.eval(isNotAsked), true, why);
    assert.deepEqual(gateway.commands, [], why);
  }
}

/// What does not change the answer leaves the question.
async function theReferenceMayChangeMeanwhile(gateway, page) {
  await asked(gateway, page, START);
  gateway.drives[0].points.speed_reference = point(30, { unit: "%" });
  Object.assign(gateway.drives[0], { age_ms: 90, turnaround_ms: 2.5, why: [{ cause: "reference_zero", evidence: "now", age_ms: 1, remedy: "" }] });
  await page.until(() => document.querySelector(".operate-confirm").innerText.includes("Start pump-1 forward, 30 %?"));
  await page.eval(click, NOW[START]);
  await page.until(told, "Start forward: confirmed");
  assert.deepEqual(gateway.commands, [{ run: true, reverse: false }]);
}

async function whatNobodySeesIsNotAsked(gateway, page) {
  await asked(gateway, page, START);
  await page.eval(() => {
    Object.defineProperty(document, "hidden", { value: true, configurable: true });
    document.dispatchEvent(new Event("visibilitychange"));
    delete document.hidden;
    document.dispatchEvent(new Event("visibilitychange"));
  });
  assert.equal(await page.eval(isNotAsked), true, "hidden");
  await asked(gateway, page, START);
  gateway.silent = true;
  await page.until(() => document.body.classList.contains("lost"));
  assert.equal(await page.eval(isNotAsked), true, "lost");
  gateway.silent = false;
  await page.until(() => !document.body.classList.contains("lost"));
  await asked(gateway, page, START);
  await page.eval(() => { location.hash = "#/"; });
  await page.until(shown, `.row ${STOP}`);
  await page.press("Enter");
  assert.equal(await page.eval(isNotAsked), true, "another view");
  // Nor by somebody else.
  await asked(gateway, page, START);
  gateway.session = { user: "bob", csrf: "token 2" };
  await page.eval(() => {
    document.dispatchEvent(new Event("visibilitychange"));
  });
  await page.until(() => document.querySelector(".login-known").innerText.includes("bob"));
  assert.equal(await page.eval(isNotAsked), true, "another user");
  await page.eval(click, START);
  assert.equal(await page.eval(isAsked), true, "and it may be asked again");
  assert.deepEqual(gateway.commands, []);
}

run([aKeyThatIsHeldAnswersNothing, aKeyThatIsHeldPressesNothingTwice, escapeClosesEveryQuestion, anyStopClosesQuestions, aStartThatIsUnderWayEndsWithAStopOfAll,
  aChangeClosesQuestions, theReferenceMayChangeMeanwhile, whatNobodySeesIsNotAsked]);
