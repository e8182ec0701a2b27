"use strict";
// A drive that another client holds, on a real gateway: taken over and released, or stopped, while its motor runs. Arguments: the address of
// the gateway, the user, the password, and `take` or `stop`. Prints each step that is done and goes on at a line of its input.
const assert = require("node:assert");
const readline = require("node:readline");
const { Browser } = require("./browser.js");
const { STOP, click, enter, shown, told } = require("./operated.js");

const [base, user, password, what] = process.argv.slice(2);
const TAKE = "button[aria-label^='pump-1: Take']";
const RELEASE = "button[aria-label='Release pump-1']";
const lines = readline.createInterface({ input: process.stdin })[Symbol.asyncIterator]();
const holder = (wanted) => document.querySelector(".operate-holder")?.innerText.includes(wanted);
const runs = () => document.querySelector(".top .badge").textContent.includes("running");

async function step(done) {
  process.stdout.write(`${done}\n`);
  await lines.next();
}

async function take(page) {
  await page.until(holder, "held by plc (automation), ");
  await page.until(runs);
  // Asked and answered at once: a question ends when the state of the drive changes.
  await page.until(() => {
    const said = document.querySelector(".operate .operate-result").textContent;
    if (!said.startsWith("Take over: sent") && said !== "Take over: done") {
      for (const label of ["pump-1: Take over …", "Take over now: pump-1"]) document.querySelector(`button[aria-label='${label}']`)?.click();
    }
    return said === "Take over: done";
  });
  await page.until(holder, "held by you, ");
  await page.until(runs);
  await step("taken");
  await page.until(shown, RELEASE);
  await page.eval(click, RELEASE);
  await page.until(told, "Release: done");
  await page.until(() => !document.querySelector(".operate-holder").innerText.includes("held by"));
  await page.until(shown, TAKE);
  await page.until(runs);
  await step("released");
}

/// Who ranks lower is not offered to take over, and stops all the same.
async function stop(page) {
  await page.until(holder, "held by plc (automation), ");
  assert.ok(!(await page.eval(shown, TAKE)), "a lower rank cannot take over");
  await page.eval(click, STOP);
  await page.until(told, "Stop: ");
  await page.until(() => !document.querySelector(".top .badge").textContent.includes("running"));
  await step("stopped");
}

async function main() {
  const browser = new Browser();
  const page = await browser.page();
  await page.open(`${base}#/drive/pump-1`);
  await enter(page, user, password);
  await page.until(shown, STOP);
  await { take, stop }[what](page);
  assert.deepEqual(page.problems, []);
  await browser.close();
  process.exit(0);
}

main().catch((error) => {
  console.error(error);
  process.exit(1);
});
