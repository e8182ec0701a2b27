"use strict";
// What an update costs with few drives and with many, when all values change.
const assert = require("node:assert");
const { Browser } = require("./browser.js");
const { FakeGateway, bus, drive, point } = require("./fake_gateway.js");

const UPDATES = 12;
const PER_LINE = 25;
// Of the part that grows with the drives; linear is 1.
const MOST_GROWTH = 1.5;

const updates = () => performance.getEntriesByType("resource").filter((entry) => entry.name.includes("/api/v1/drives")).length;

/// Time of scripts, and of style and layout, for an update, and the intervals between frames meanwhile, ms.
async function cost(browser, url, drives) {
  const page = await browser.page({ calm: false });
  await page.open(`${url}#/`);
  await page.until((drives) => document.querySelectorAll(".rows .row").length >= drives && performance.getEntriesByType("resource").filter((entry) => entry.name.includes("/api/v1/drives")).length > 2, drives);
  assert.equal(await page.eval(() => document.querySelectorAll(".rows .row").length), drives);
  await page.eval(() => {
    window.frames = [];
    let last = performance.now();
    const frame = (now) => {
      window.frames.push(now - last);
      last = now;
      requestAnimationFrame(frame);
    };
    requestAnimationFrame(frame);
  });
  const [before, first] = [await page.spent(), await page.eval(updates)];
  const script = await page.profile(() => page.until((end) => performance.getEntriesByType("resource").filter((entry) => entry.name.includes("/api/v1/drives")).length >= end, first + UPDATES));
  const [after, last] = [await page.spent(), await page.eval(updates)];
  const frames = (await page.eval("window.frames")).sort((a, b) => a - b);
  const each = (name) => (1000 * (after[name] - before[name])) / (last - first);
  const at = (share) => frames[Math.min(frames.length - 1, Math.floor(share * frames.length))];
  await page.close();
  return { drives, script: script / (last - first), layout: each("LayoutDuration") + each("RecalcStyleDuration"), frames: [at(0.5), at(0.95), at(0.99), at(1)] };
}

/// Values of a moment: other ones at each, as far as they are shown.
function drives(count, moment) {
  return Array.from({ length: count }, (_, place) => {
    const value = (unit, factor) => point(((place * 7 + moment * 13) % 970) * factor, { unit });
    const points = { actual_speed: value("%", 0.1), output_frequency: value("Hz", 0.05), motor_speed: value("rpm", 1.4), motor_current: value("A", 0.1), motor_torque: value("%", 0.1),
      motor_power: value("%", 0.1), dc_link_voltage: value("V", 0.6), heatsink_temperature: value("°C", 0.1), speed_reference: value("%", 0.1), warning: point(false), fault_code: point(0) };
    return drive(`pump-${place}`, { bus: `line${Math.floor(place / PER_LINE)}`, state: "running", age_ms: (place * 3 + moment * 31) % 90, points });
  });
}

async function costOf(browser, count) {
  const gateway = new FakeGateway();
  gateway.buses = Array.from({ length: count / PER_LINE }, (_, place) => bus(`line${place}`));
  let moment = 0;
  const change = () => {
    moment += 1;
    gateway.drives = drives(count, moment);
  };
  change();
  const timer = setInterval(change, 900);
  const result = await cost(browser, await gateway.start(), count);
  clearInterval(timer);
  await gateway.stop();
  return result;
}

async function main() {
  const browser = new Browser();
  const [few, many] = [await costOf(browser, 100), await costOf(browser, 1000)];
  await browser.close();
  for (const { drives, script, layout, frames } of [few, many]) {
    console.log(`${drives} drives: scripts ${script.toFixed(1)} ms, style and layout ${layout.toFixed(1)} ms an update; frames ${frames.map((ms) => ms.toFixed(1)).join(" / ")} ms (50 / 95 / 99 / 100 %)`);
  }
  const growth = many.script / few.script / (many.drives / few.drives);
  console.log(`scripts: ${growth.toFixed(2)} x linear`);
  assert.ok(growth <= MOST_GROWTH, `scripts take ${growth.toFixed(2)} x linear`);
}

main().catch((error) => {
  console.error(error);
  process.exit(1);
});
