"use strict";
// A page that is operated: a gateway that takes commands, a login, and steps that are taken one after another.
const assert = require("node:assert");
const { Browser } = require("./browser.js");
const { FakeGateway, drive, point } = require("./fake_gateway.js");

const STOP = "button[aria-label='Stop pump-1']";

const click = (selector) => document.querySelector(selector).click();
const shown = (selector) => document.querySelector(selector)?.checkVisibility() && document.querySelector(selector).innerText;

/// The result of a command, at the controls or in the row of the drive.
const told = (wanted) => [...document.querySelectorAll(".operate-result, .notice")].some((each) => each.textContent.includes(wanted));

const REFERENCE = { name: "speed_reference", kind: "number", unit: "%", minimum: 0, maximum: 80 };

function plant(gateway, more = {}) {
  const points = { actual_speed: point(0, { unit: "%" }), speed_reference: point(62.5, { unit: "%" }), reversed: point(false), reverse: point(false) };
  gateway.drives = [drive("pump-1", { access: "control", points, ...more })];
  gateway.about = { drive: "pump-1", points: [{ name: "run", kind: "bool" }, { name: "reverse", kind: "bool" }, REFERENCE], lease_ms: null, commanded_last: false };
  Object.assign(gateway, { operating: true, commands: [], silent: false, obey: () => [200, { result: "confirmed", confirmed_ms: 20 }] });
}

/// Logs in by the form in the header.
async function enter(page, user, password) {
  await page.until(() => document.querySelector("#login .login-open")?.checkVisibility());
  await page.eval(click, ".login-open");
  await page.until(() => document.activeElement.name === "user");
  await page.type(user);
  await page.eval(() => document.querySelector("#login-fold input[name=password]").focus());
  await page.type(password);
  await page.press("Enter");
  await page.until(shown, ".login-known");
}

async function logIn(gateway, page) {
  if (gateway.session) return page.until(shown, ".login-known");
  await enter(page, "alice", "correct horse");
}

async function opened(gateway, page, address = "#/", more = {}) {
  plant(gateway, more);
  await page.open("about:blank");
  await page.open(`${gateway.url}${address}`);
  await page.until(() => document.querySelector(".login-known"));
  await logIn(gateway, page);
  await page.until(shown, STOP);
}

/// Takes the steps, or the one that the command line names, each with the gateway and a page.
async function take(steps) {
  const gateway = new FakeGateway();
  gateway.url = await gateway.start();
  const browser = new Browser();
  const page = await browser.page();
  for (const step of steps) {
    if (process.argv[2] && step.name !== process.argv[2]) continue;
    try {
      await step(gateway, page);
    } catch (error) {
      throw new Error(`${step.name}: ${error.stack}`);
    }
    // Requests that are refused or cut off are what the step is about.
    const problems = page.problems.filter((problem) => !/net::ERR_|cannot read the gateway|status of (401|403|502|503)/.test(problem));
    assert.deepEqual(problems, [], step.name);
  }
  await browser.close();
  await gateway.stop();
}

/// The same; the process ends with an error where one fails.
function run(steps) {
  take(steps).catch((error) => {
    console.error(error);
    process.exit(1);
  });
}

module.exports = { STOP, click, enter, logIn, opened, plant, run, shown, told };
