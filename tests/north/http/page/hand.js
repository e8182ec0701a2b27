"use strict";
// The page in the hand of an operator: what is pressed keeps its place and the focus, and is large enough for a finger. Drives a real
// browser against a gateway that says what the test wants.
const assert = require("node:assert");
const { STOP, click, opened, run, shown, told } = require("./operated.js");
const { point } = require("./fake_gateway.js");

const START = "button[aria-label='Start pump-1']";
const SET = "button[aria-label='Set the reference of pump-1']";
const INPUT = ".operate-reference input";
const FINGER_PX = 44;

const boxes = (selectors) => selectors.map((selector) => {
  const { x, y, width, height } = document.querySelector(selector).getBoundingClientRect();
  return [selector, x, y, width, height].join(" ");
});

async function sized(page, width, height) {
  await page.send("Emulation.setDeviceMetricsOverride", { width, height, deviceScaleFactor: 1, mobile: width < 600 });
}

const CAUSES = [
  { cause: "fault", evidence: "fault 1: overcurrent (a long text of the manual that takes its room)", age_ms: 10, remedy: "check the cable; then write fault_reset" },
  { cause: "no_run_order", evidence: "run is off in the drive", age_ms: 10, remedy: "send run" },
];

/// What comes and goes by itself, each with a sign that it is shown.
const COMING = {
  "a reason": [(gateway) => Object.assign(gateway.drives[0], { why: CAUSES, blocked_by: ["fault"] }), ".causes li"],
  "a fault": [(gateway) => {
    Object.assign(gateway.drives[0], { state: "fault", fault_text: "overcurrent" });
    Object.assign(gateway.drives[0].points, { fault_code: point(1), warning: point(true) });
  }, ".view > .why"],
  "a value that is old": [(gateway) => Object.assign(gateway.drives[0], { quality: "stale", age_ms: 5000 }), ".top .tag:not(.amber)"],
  "another holder": [(gateway) => Object.assign(gateway.drives[0], { hold: "held", holder: "a-controller-with-a-long-name", holder_rank: "automation", hold_left_s: 24 }), ".operate-holder"],
  "a lost connection": [(gateway) => { gateway.silent = true; }, "#banner-text"],
};

async function nothingMovesTheStop(gateway, page) {
  for (const [width, height] of [[1440, 900], [390, 844]]) {
    await sized(page, width, height);
    for (const [what, [come, sign]] of Object.entries(COMING)) {
      await opened(gateway, page, "#/drive/pump-1");
      await page.until(shown, ".operate-reference");
      // The row of a reset comes behind the others.
      const kept = what === "another holder" ? [STOP] : [STOP, INPUT, SET];
      const before = await page.eval(boxes, kept);
      const good = structuredClone(gateway.drives[0]);
      come(gateway);
      await page.until(shown, sign);
      assert.deepEqual(await page.eval(boxes, kept), before, `${what} comes at ${width} px`);
      gateway.drives[0] = good;
      gateway.silent = false;
      await page.until((sign) => !document.querySelector(sign)?.checkVisibility(), sign);
      assert.deepEqual(await page.eval(boxes, kept), before, `${what} goes at ${width} px`);
    }
  }
  await sized(page, 1400, 900);
}

/// A stop that fails shows a banner, and a question is asked behind what else can be pressed.
async function nothingThatIsSaidMovesTheStop(gateway, page) {
  await sized(page, 390, 844);
  await opened(gateway, page, "#/drive/pump-1");
  await page.until(shown, ".operate-reference");
  const kept = [STOP, START, INPUT, SET];
  const before = await page.eval(boxes, kept);
  await page.eval(click, START);
  await page.until(shown, ".operate-confirm");
  assert.deepEqual(await page.eval(boxes, kept), before, "a question");
  await page.press("Escape");
  gateway.obey = () => [502, { result: "garbled", error: { code: "garbled", message: "no sound reply" } }];
  await page.eval(click, STOP);
  await page.until(shown, "#stops .not-stopped");
  assert.deepEqual(await page.eval(boxes, kept), before, "a stop that failed");
  // What lies under the banner can be scrolled to.
  await page.eval(() => window.scrollTo(0, 100000));
  const [end, banner] = await page.eval(() => [document.querySelector("footer").getBoundingClientRect().bottom, document.querySelector("#alerts").getBoundingClientRect().top]);
  assert.ok(end <= banner + 1, `the page ends at ${end} px, the banner begins at ${banner} px`);
  await page.eval(click, "#stops button");
  await sized(page, 1400, 900);
}

async function theFocusStays(gateway, page) {
  await opened(gateway, page, "#/drive/pump-1");
  await page.until(shown, ".operate-reference");
  const focused = () => document.activeElement.getAttribute("aria-label") ?? document.activeElement.tagName;
  await page.eval((start) => document.querySelector(start).focus(), START);
  await page.press("Enter");
  await page.press("Enter");
  await page.until(told, "confirmed");
  gateway.drives[0].state = "running";
  await page.until(shown, "button[aria-label='pump-1: Reverse …']");
  assert.equal(await page.eval(focused), "pump-1: Reverse …", "what took the place of Start");
  gateway.drives[0].state = "ready";
  await page.until(shown, START);
  assert.equal(await page.eval(focused), "Start pump-1");
  // A drive that has no reverse.
  await opened(gateway, page, "#/drive/pump-1");
  gateway.about.points = gateway.about.points.filter(({ name }) => name !== "reverse");
  await page.send("Page.reload");
  await page.until(shown, ".operate-reference");
  await page.eval((start) => document.querySelector(start).focus(), START);
  await page.press("Enter");
  await page.press("Enter");
  await page.until(told, "confirmed");
  gateway.drives[0].state = "running";
  await page.until((start) => !document.querySelector(start).checkVisibility(), START);
  assert.equal(await page.eval(focused), "Set the reference of pump-1");
  // A reset that worked.
  await opened(gateway, page, "#/drive/pump-1", { state: "fault" });
  await page.until(shown, "button[aria-label='Reset the fault of pump-1']");
  await page.eval(() => document.querySelector("button[aria-label='Reset the fault of pump-1']").focus());
  await page.press("Enter");
  await page.until(told, "confirmed");
  gateway.drives[0].state = "ready";
  await page.until(() => !document.querySelector("button[aria-label='Reset the fault of pump-1']").checkVisibility());
  assert.equal(await page.eval(focused), "Start pump-1");
}

async function fingersFit(gateway, page) {
  await sized(page, 390, 844);
  await opened(gateway, page, "#/drive/pump-1", { state: "fault" });
  await page.until(shown, ".operate-reference");
  const tooSmall = (least) => [...document.querySelectorAll(".operate button, .operate input:not([type=radio])")].filter((each) => each.checkVisibility() && each.getBoundingClientRect().height < least)
    .map((each) => each.outerHTML);
  assert.equal(await page.eval(() => [...document.querySelectorAll(".operate button, .operate input:not([type=radio])")].filter((each) => each.checkVisibility()).length), 5, "STOP, Start, input, Set, Reset");
  assert.deepEqual(await page.eval(tooSmall, FINGER_PX), []);
  await page.eval(click, START);
  await page.until(shown, ".operate-confirm");
  assert.deepEqual(await page.eval(tooSmall, FINGER_PX), [], "a question");
  await sized(page, 1400, 900);
}

run([nothingMovesTheStop, nothingThatIsSaidMovesTheStop, theFocusStays, fingersFit]);
