"use strict";
// Who holds a drive, seen and changed on the page: taken, taken over from a lower rank, released, while the motor goes on. Drives a real
// browser against a gateway that says what the test wants.
const assert = require("node:assert");
const { STOP, click, opened, run, shown, told } = require("./operated.js");

const AXE = require("node:fs").readFileSync(require.resolve("axe-core"), "utf8");
const DRIVE = "#/drive/pump-1";
const TAKE = "button[aria-label^='pump-1: Take']";
const RELEASE = "button[aria-label='Release pump-1']";
const NOW = "button[aria-label='Take over now: pump-1']";
const BY_PLC = { state: "running", hold: "held", holder: "plc-1", holder_rank: "automation", hold_left_s: 24 };
const FREE = { hold: "free", holder: null, holder_rank: null, hold_left_s: 0 };
const HERE = { hold: "held", holder: "alice", holder_rank: "operator", hold_left_s: 30 };

async function held(gateway, page, hold, outranks = ["automation"]) {
  await opened(gateway, page, DRIVE, hold);
  Object.assign(gateway.about, { principal: "alice", outranks });
  await page.send("Page.reload");
  await page.until(shown, ".operate-reference");
}

async function aRunningDriveIsTakenOver(gateway, page) {
  await held(gateway, page, BY_PLC);
  const box = () => JSON.stringify(document.querySelector(".operate-stop").getBoundingClientRect());
  const before = await page.eval(box);
  assert.match(await page.eval(shown, ".operate-holder"), /held by plc-1 \(automation\), 24 s left\s*Take over …/);
  await page.eval(click, TAKE);
  assert.match(await page.eval(shown, ".operate-confirm"), /Take pump-1 over from plc-1 \(automation\)\? The motor goes on as it is\./);
  const violations = await page.violations(AXE);
  assert.deepEqual(violations, [], violations.join("\n"));
  await page.press("Escape");
  assert.deepEqual(gateway.commands, []);
  await page.eval(click, TAKE);
  await page.eval(click, NOW);
  await page.until(told, "Take over: done");
  Object.assign(gateway.drives[0], HERE);
  await page.until(shown, RELEASE);
  assert.match(await page.eval(shown, ".operate-holder"), /held by you, 30 s left/);
  assert.deepEqual(gateway.commands, [{ action: "break" }], "and nothing else: the motor goes on");
  assert.equal(await page.eval(box), before, "STOP keeps its place");
  // The hold is renewed while somebody is active.
  await page.until(() => document.querySelector(".operate-lease").textContent.includes("Kept by this page"));
  const since = gateway.asked.length;
  await page.press("Tab");
  for (let waited = 0; waited < 100 && !gateway.asked.slice(since).some((address) => address.endsWith("/heartbeat")); waited += 1) await new Promise((done) => setTimeout(done, 100));
  assert.ok(gateway.asked.slice(since).some((address) => address.endsWith("/heartbeat")), "the hold is renewed");
  await page.eval((release) => document.querySelector(release).focus(), RELEASE);
  await page.press("Enter");
  await page.until(told, "Release: done");
  Object.assign(gateway.drives[0], FREE);
  await page.until(shown, TAKE);
  assert.equal(await page.eval(() => document.activeElement.getAttribute("aria-label")), "pump-1: Take", "the focus stays");
  assert.deepEqual(gateway.commands, [{ action: "break" }, { action: "release" }]);
  assert.equal(await page.eval(shown, ".operate-lease"), false, "and kept no more");
}

async function whoRanksTooLowIsNotOfferedIt(gateway, page) {
  for (const [hold, outranks] of [[BY_PLC, []], [{ ...FREE, hold: "reserved", holder: "bob", holder_rank: "supervisor", hold_left_s: 9 }, ["automation"]], [{ ...FREE, hold: "local" }, ["automation"]]]) {
    await held(gateway, page, hold, outranks);
    assert.equal(await page.eval(shown, TAKE), false, JSON.stringify(hold));
    assert.equal(await page.eval(shown, RELEASE), false);
    assert.equal(await page.eval(shown, STOP), "■ STOP", "a stop is always offered");
  }
  // A gateway without holders has neither.
  await opened(gateway, page, DRIVE);
  await page.until(shown, ".operate-reference");
  assert.equal(await page.eval(shown, ".operate-holder"), false);
}

async function aRefusalIsSaid(gateway, page) {
  await held(gateway, page, FREE);
  gateway.obey = () => [403, { result: "held_by_other", error: { code: "held_by_other", message: "plc-1 (automation) holds the drive" }, holder: "plc-1", holder_rank: "automation", hold_left_s: 12 }];
  await page.eval(click, TAKE);
  await page.until(told, "Take: held by plc-1 (automation), 12 s left");
  assert.deepEqual(gateway.commands, [{ action: "take" }]);
}

/// A change of the holder ends the question.
async function aChangeEndsTheQuestion(gateway, page) {
  await held(gateway, page, BY_PLC);
  await page.eval(click, TAKE);
  Object.assign(gateway.drives[0], { holder: "plc-2" });
  await page.until(told, "Take over: nothing was sent, pump-1 has changed");
  assert.deepEqual(gateway.commands, []);
}

run([aRunningDriveIsTakenOver, whoRanksTooLowIsNotOfferedIt, aRefusalIsSaid, aChangeEndsTheQuestion]);
