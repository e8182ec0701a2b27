"use strict";
// Operating from the page: what becomes of a stop, what is understood of a reference, in which direction a motor starts. Drives a
// real browser against a gateway that says what the test wants.
const assert = require("node:assert");
const { STOP, click, logIn, opened, plant, run, shown, told } = require("./operated.js");
const { point } = require("./fake_gateway.js");

const DRIVE = "#/drive/pump-1";
const AXE = require("node:fs").readFileSync(require.resolve("axe-core"), "utf8");

const inBanner = (wanted) => document.getElementById("stops").innerText.includes(wanted);

async function accessible(page, state) {
  const violations = await page.violations(AXE);
  assert.deepEqual(violations, [], state);
}

// Covered by nothing, wherever the page is scrolled to.
const bannerIsOnTop = () => {
  const { x, y, width } = document.querySelector(".not-stopped").getBoundingClientRect();
  return y >= 0 && y < innerHeight && document.elementFromPoint(x + width / 2, y + 8)?.closest(".not-stopped") !== null;
};

async function aStopThatIsRefusedCannotBeMissed(gateway, page) {
  await opened(gateway, page, "#/drive/pump-1", { state: "running" });
  // The gateway was started anew so fast that nobody noticed.
  gateway.session = null;
  await page.eval(click, STOP);
  await page.until(inBanner, "pump-1 was not stopped.");
  const said = await page.eval(shown, "#stops");
  for (const wanted of [/Stop it at the machine\./, /The session has ended; log in again\./, /Sent once, at .*; it is not sent again/]) assert.match(said, wanted);
  assert.equal(await page.eval(() => document.querySelector("#stops [role=alert]").checkVisibility()), true);
  assert.deepEqual(gateway.commands, []);
  await accessible(page, "a stop that was refused");
  await page.eval(() => window.scrollTo(0, 10000));
  assert.ok(await page.eval(bannerIsOnTop), "the banner is over everything");
  // Neither a login nor another view takes it away, and a stop that is carried out is told beside it.
  await logIn(gateway, page);
  await page.eval(() => { location.hash = "#/"; });
  await page.until(shown, STOP);
  assert.ok(await page.eval(inBanner, "pump-1 was not stopped."));
  await page.eval(click, STOP);
  await page.until(inBanner, "was carried out: confirmed");
  assert.deepEqual(gateway.commands, [{ run: false }]);
  await page.eval(click, "#stops button[aria-label='Dismiss: the stop of pump-1']");
  assert.equal(await page.eval(() => document.getElementById("stops").innerText), "");
  assert.notEqual(await page.eval(() => document.activeElement.tagName), "BODY", "the focus is not lost");
}

async function aStopWithoutAnAnswerIsSentAgain(gateway, page) {
  await opened(gateway, page, "#/", { state: "running" });
  let carriesOut = false;
  gateway.obey = () => (!carriesOut ? [503, { result: "bus_down", error: { code: "bus_down", message: "line1 is down" } }] : [200, { result: "confirmed", confirmed_ms: 20 }]);
  await page.eval(click, STOP);
  await page.until(() => /Sent \d+ times since/.test(document.getElementById("stops").innerText));
  assert.match(await page.eval(shown, "#stops"), /pump-1 was not stopped\. Stop it at the machine\. Bus down: line1 is down\.\s+.*it is being sent again/);
  carriesOut = true;
  await page.until(inBanner, "was carried out");
  assert.ok(gateway.commands.length >= 2);
  await page.eval(click, "#stops button");
  // Of an answer that says so nobody knows.
  gateway.obey = () => [502, { result: "garbled", error: { code: "garbled", message: "no sound reply" } }];
  await page.eval(click, STOP);
  await page.until(inBanner, "pump-1 may not have stopped.");
  await page.eval(click, "#stops button");
}

async function aGatewayThatIsAwayIsTold(gateway, page) {
  await opened(gateway, page, "#/", { state: "running" });
  gateway.silent = true;
  await page.until(() => document.body.classList.contains("lost"));
  await page.eval(click, STOP);
  await page.until(inBanner, "pump-1 may not have stopped.");
  const [filter, own] = await page.eval(() => ["#stops .not-stopped", ".operate-stop"].map((selector) => {
    const grey = [];
    for (let element = document.querySelector(selector); element; element = element.parentElement) grey.push(getComputedStyle(element).filter, getComputedStyle(element).opacity);
    return grey.every((value) => value === "none" || value === "1");
  }));
  assert.ok(filter && own, "neither the banner nor the stop is greyed out");
  const count = await page.eval(() => Number(/No reply to (\d+) requests/.exec(document.getElementById("banner").innerText)[1]));
  await page.until((count) => Number(/No reply to (\d+) requests/.exec(document.getElementById("banner").innerText)[1]) > count, count);
  // It was started anew meanwhile: its page learns that before somebody relies on a stop.
  gateway.session = null;
  gateway.silent = false;
  await page.until(() => !document.body.classList.contains("operating"));
  assert.match(await page.eval(shown, "#login-fold"), /The session has ended/);
  assert.ok(await page.eval(inBanner, "pump-1 may not have stopped."), "the banner stays");
  await page.until(inBanner, "it is not sent again");
}

/// Before anybody relies on a stop: when the gateway returns, not only every ten seconds.
async function aGatewayThatWasStartedAnewIsNoticed(gateway, page) {
  const source = "const real = setInterval; window.setInterval = (work, ms) => real(work, ms === 10000 ? 1e9 : ms);";
  const { identifier } = await page.send("Page.addScriptToEvaluateOnNewDocument", { source });
  await opened(gateway, page, "#/", { state: "running" });
  await page.send("Page.removeScriptToEvaluateOnNewDocument", { identifier });
  gateway.silent = true;
  await page.until(() => document.body.classList.contains("lost"));
  gateway.session = null;
  gateway.silent = false;
  await page.until(() => !document.body.classList.contains("operating"));
  assert.match(await page.eval(shown, "#login-fold"), /The session has ended/);
  assert.deepEqual(gateway.commands, []);
}

async function anotherTabLoggedIn(gateway, page) {
  await opened(gateway, page, "#/", { state: "running" });
  gateway.session = { user: "alice", csrf: "token 2" };
  await page.eval(click, STOP);
  await page.until(told, "confirmed");
  assert.deepEqual(gateway.commands, [{ run: false }]);
  assert.equal(await page.eval(() => document.getElementById("stops").innerText), "", "nothing failed");
}

async function referencesAreUnderstoodAsTyped(gateway, page) {
  await opened(gateway, page, DRIVE);
  await page.until(shown, ".operate-reference");
  const typed = async (text) => {
    await page.eval(() => Object.assign(document.querySelector(".operate-reference input"), { value: "" }).focus());
    await page.type(text);
    return page.eval(() => document.querySelector(".understood").innerText);
  };
  assert.deepEqual(await page.eval(() => ["type", "inputMode"].map((name) => document.querySelector(".operate-reference input")[name])), ["text", "decimal"]);
  assert.equal(await typed("3,5"), "= 3.5 %");
  assert.deepEqual(gateway.commands, [], "nothing is sent before it is confirmed");
  await page.press("Enter");
  await page.until(told, "Reference 3.5 %: confirmed");
  for (const [text, understood] of [["3.5", "= 3.5 %"], [" 62,25 ", "= 62.25 %"], ["0", "= 0 %"], ["+7,", "= 7 %"]]) assert.equal(await typed(text), understood, text);
  for (const text of ["3,5,1", "1.234,5", "3 5", "1e3", "12a", "0x10", "-", ","]) {
    assert.match(await typed(text), /enter a number from 0 to 80 %/, text);
    await page.press("Enter");
    await page.until(told, "nothing was sent");
  }
  for (const text of ["80,1", "-0,1", "350"]) {
    assert.match(await typed(text), /is not from 0 to 80 %/, text);
    await page.press("Enter");
  }
  assert.deepEqual(gateway.commands, [{ speed_reference: 3.5 }]);
}

async function startsTellTheirDirection(gateway, page) {
  await opened(gateway, page, DRIVE);
  const asked = () => document.querySelector(".operate-confirm").innerText;
  await page.until(shown, ".operate-reference");
  await page.eval(click, "button[aria-label='Start pump-1']");
  await page.until(shown, ".operate-confirm");
  assert.match(await page.eval(asked), /Start pump-1 forward, 62\.5 %\?/);
  await page.eval(() => [...document.querySelectorAll(".operate-directions input")].find((radio) => radio.value === "true").click());
  assert.match(await page.eval(asked), /Start pump-1 reverse, 62\.5 %\?/);
  await accessible(page, "while it asks");
  assert.deepEqual(gateway.commands, []);
  await page.eval(click, "button[aria-label='Start now: pump-1']");
  await page.until(told, "Start reverse: confirmed");
  assert.deepEqual(gateway.commands, [{ run: true, reverse: true }]);
  // While it runs, it is turned round, after a question too; the overview says which way it turns.
  const running = { state: "running", points: { ...gateway.drives[0].points, reversed: point(true), reverse: point(true) } };
  plant(gateway, running);
  await page.eval(() => { location.hash = "#/"; });
  await page.until(() => [...document.querySelectorAll(".row .direction")].some((each) => each.textContent.trim() === "← reverse"));
  assert.equal(await page.eval(() => document.querySelectorAll(".row:not(.head) button").length), 1, "a row has its stop and nothing else");
  await page.eval(() => { location.hash = "#/drive/pump-1"; });
  await page.until(shown, "button[aria-label='pump-1: Forward …']");
  assert.equal(await page.eval(shown, "button[aria-label='Start pump-1']"), false);
  await page.eval(click, "button[aria-label='pump-1: Forward …']");
  assert.match(await page.eval(asked), /pump-1 forward, 62\.5 %\?/);
  await page.eval(click, "button[aria-label='Change direction now: pump-1']");
  await page.until(told, "Direction forward: confirmed");
  assert.deepEqual(gateway.commands, [{ reverse: false }]);
}

async function theStickyStopNamesItsDrive(gateway, page) {
  await opened(gateway, page, "#/drive/pump-1");
  await page.until(() => document.querySelector(".view > .operate .operate-name")?.checkVisibility());
  assert.equal(await page.eval(() => document.querySelector(".view > .operate .operate-name").innerText), "pump-1");
}

run([aStopThatIsRefusedCannotBeMissed, aStopWithoutAnAnswerIsSentAgain, aGatewayThatIsAwayIsTold, aGatewayThatWasStartedAnewIsNoticed, anotherTabLoggedIn, referencesAreUnderstoodAsTyped,
    startsTellTheirDirection, theStickyStopNamesItsDrive]);
