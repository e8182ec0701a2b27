"use strict";
// A user's path over the page, in Chromium: values, login, reference, start, fault, reset, start, stop all. Arguments: the address of the
// gateway, the name of its drive, the password of alice. Prints `running` when the motor runs; then it waits for a fault, which the
// test causes.
const assert = require("node:assert");
const { Browser } = require("../../north/http/page/browser.js");
const { click, enter, shown } = require("../../north/http/page/operated.js");

const [base, name, password] = process.argv.slice(2);
const badge = (word) => document.querySelector(".top .badge")?.textContent.includes(word);
const isNot = (word) => document.querySelector(".top .badge")?.textContent.includes(word) === false;
const result = () => document.querySelector(".operate .operate-result").textContent;
/// A command of that name that was carried out.
const done = (what) => new RegExp(`^${what}.*: (confirmed|acknowledged)`).test(document.querySelector(".operate .operate-result").textContent);
/// A speed or a frequency above 0 that is good.
const turns = () => [...document.querySelectorAll(".figures .value.main")].slice(0, 2).some((value) => Number(value.textContent) > 0);

/// Asks and answers at once: a question ends when the state of the drive changes. On a busy machine an order may expire, and is given
/// again.
async function ordered(page, what, question, answer) {
  for (let tries = 0; ; tries += 1) {
    await page.until(shown, question);
    await page.eval((question, answer) => {
      document.querySelector(question).click();
      if (answer) document.querySelector(answer).click();
    }, question, answer);
    await page.until(() => !/sent …$/.test(document.querySelector(".operate .operate-result").textContent));
    if (await page.eval(done, what)) return;
    assert.ok(tries < 10, await page.eval(result));
  }
}

async function start(page) {
  await ordered(page, "Start", `button[aria-label='Start ${name}']`, `button[aria-label='Start now: ${name}']`);
  await page.until(badge, "running");
  await page.until(turns);
}

async function main() {
  const browser = new Browser();
  const page = await browser.page();
  await page.open(`${base}#/`);
  await page.until(() => document.querySelectorAll(".rows .row .value.main").length > 1);
  await enter(page, "alice", password);
  await page.eval(click, `.rows a[href='#/drive/${name}']`);
  await page.until(() => document.querySelector(".operate-reference input")?.checkVisibility());
  await page.eval(() => document.querySelector(".operate-reference input").focus());
  await page.type("40");
  await ordered(page, "Reference 40 ", ".operate-reference button");
  await start(page);
  process.stdout.write("running\n");
  await page.until(badge, "fault");
  await ordered(page, "Reset", `button[aria-label='Reset the fault of ${name}']`);
  await page.until(isNot, "fault");
  assert.ok(await page.eval(isNot, "running"), "a reset starts nothing");
  await start(page);
  await page.until(shown, "#stop-all");
  await page.eval(() => {
    document.querySelector("#stop-all").click();
    document.querySelector("#stops .operate-stop").click();
  });
  await page.until(() => document.getElementById("stops").innerText.includes("All drives have stopped: 1 of 1"));
  await page.until(isNot, "running");
  assert.deepEqual(page.problems.filter((problem) => !/status of (401|409|503|504)/.test(problem)), []);
  await browser.close();
  process.stdout.write("stopped\n");
}

main().catch((error) => {
  console.error(error);
  process.exit(1);
});
