"use strict";
// Every view of a plant where everything occurs. Argument: the address of the gateway.
const assert = require("node:assert");
const fs = require("node:fs");
const { Browser } = require("./browser.js");

const AXE = fs.readFileSync(require.resolve("axe-core"), "utf8");
const SIZES = [[1400, 900], [800, 900], [400, 800]];
const NASTY = "<img src=x onerror=window.hacked=1>";

// Address, a sign that it is complete, and words that must be seen.
const views = (recording) => [
  ["#/", ".rows .row", ["pump-1", "▶ running", "▲ fault", "F1 overcurrent", "F7 saturation trip", "✕ offline", "the adapter is gone", NASTY, "local control", "stale", "7 of 9"]],
  ["#/drive/pump-1", ".curve", ["Trends", "Counted by the gateway", "vacon-nx", "heatsink temperature", "Starts", "−60 min"]],
  ["#/drive/pump-2", ".causes li", ["F1 overcurrent", "Why it does not run", "speed_reference=84", "mqtt", "scada", "overcurrent; speed"]],
  ["#/drive/never-1", ".figures div", ["never read"]],
  ["#/drive/blower-2", ".figures .stale", ["✕ offline", "stale, "]],
  [`#/drive/${encodeURIComponent(NASTY)}`, ".causes li", [NASTY, "F7 saturation trip"]],
  ["#/lines", ".card", ["line1", "● up", "the adapter is gone", "Line load"]],
  ["#/line/line1", ".strip .minutes rect", ["Load and cycle", "errors", "to 2 ms", "pump-2"]],
  ["#/events", ".events li", ["has fault 1: overcurrent", NASTY, "recording"]],
  ["#/recordings", ".list td a", ["fault 1: overcurrent"]],
  [`#/recording/${recording}`, ".plots .curve", ["Recording: fault of pump-2", "Current", "has fault 1", "running", "read holding ", " registers: ", "CSV of the values"]],
];

async function looks(page, [hash, sign, wanted], base, check) {
  await page.open(`${base}${hash}`);
  await page.until((hash, sign) => location.hash === hash && document.querySelector("#live:not([hidden])") && document.querySelector(sign), hash, sign);
  for (const words of wanted) {
    await page.until((words) => document.body.innerText.toLowerCase().includes(words.toLowerCase()), words);
  }
  const width = await page.eval("[document.documentElement.scrollWidth, innerWidth]");
  assert.ok(width[0] <= width[1], `${hash} is ${width[0]} px wide in a window of ${width[1]} px`);
  if (!check) return;
  const violations = await page.violations(AXE);
  assert.equal(violations.join("\n"), "", `${hash} at ${width[1]} px`);
}

/// From the top of the page to a drive, its trends and back, by keys alone; what has the focus is seen. The keys are faster than
/// the connection.
async function keyboardIsEnough(page, base) {
  await page.slow(300);
  await page.open(`${base}#/`);
  await page.until(() => document.querySelector(".rows .row"));
  await page.eval(() => document.activeElement.blur());
  const focused = () => {
    // Between the last element and the first one the focus is with the browser.
    if (document.activeElement === document.body) return ["", true];
    const { outlineStyle, outlineWidth, boxShadow } = getComputedStyle(document.activeElement);
    return [document.activeElement.textContent || document.activeElement.getAttribute("aria-label") || document.activeElement.id, outlineStyle !== "none" && outlineWidth !== "0px" || boxShadow !== "none"];
  };
  const tabTo = async (name) => {
    for (let presses = 0; presses < 80; presses += 1) {
      await page.press("Tab");
      const [text, visible] = await page.eval(focused);
      assert.ok(visible, `the focus on ${text} is not seen`);
      if (text === name) return;
    }
    assert.fail(`${name} is not reached by Tab`);
  };
  await tabTo("Skip to the content");
  await tabTo("Drives");
  await tabTo("filter");
  await tabTo("pump-1");
  await page.press("Enter");
  await page.until(() => document.querySelector("h1").textContent === "pump-1" && document.querySelector(".curve"));
  await tabTo("1 h");
  await page.press("Enter");
  await page.until(() => document.querySelector('.choices [aria-pressed="true"]').textContent === "1 h");
  await tabTo("Cursor of the trends");
  await page.until(() => document.querySelectorAll(".curve").length > 3);
  await page.press("ArrowLeft");
  const said = await page.eval(() => document.activeElement.getAttribute("aria-valuetext"));
  assert.match(said, /\d\d:\d\d:\d\d: Speed .*, Current .*/);
  await tabTo("all");
  // The trends are drawn again and again; the focus stays.
  for (const _ of [1, 2]) {
    await page.eval(() => { window.drawn = document.querySelector(".curve"); });
    await page.until(() => !window.drawn.isConnected);
  }
  assert.equal(await page.eval("document.activeElement.textContent"), "all", "a refresh takes the focus away");
}

/// Longer words fit, too.
async function otherLanguagesFit(browser, views, base) {
  const page = await browser.page({ width: 390, height: 800, language: "de" });
  for (const [hash, sign] of views) await looks(page, [hash, sign, hash === "#/" ? ["Umrichter", "Leitungen"] : []], base, true);
  await page.close();
}

async function main() {
  const base = process.argv[2];
  const [{ id }] = await (await fetch(`${base}api/v1/recordings`)).json();
  const browser = new Browser();
  for (const [place, [width, height]] of SIZES.entries()) {
    for (const dark of [false, true]) {
      const page = await browser.page({ width, height, dark });
      // The structure is the same in both schemes and at all widths that differ by nothing but columns: contrast and layout are not.
      for (const view of views(id)) await looks(page, view, base, place !== 1 || dark);
      if (place === 0 && !dark) await keyboardIsEnough(page, base);
      const problems = page.problems.filter((problem) => !problem.includes("/diagnosis"));
      assert.deepEqual(problems, []);
      assert.equal(await page.eval("window.hacked"), undefined, "a text became markup");
      await page.close();
    }
  }
  await otherLanguagesFit(browser, views(id), base);
  await browser.close();
}

main().catch((error) => {
  console.error(error);
  process.exit(1);
});
