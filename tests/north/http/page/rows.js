"use strict";
// The overview of 60 drives after login: compact rows, a stop in each, colour only where a person is wanted. Drives a real browser
// against a gateway that says what the test wants.
const assert = require("node:assert");
const { click, logIn, plant, run, shown, told } = require("./operated.js");
const { bus, drive, point } = require("./fake_gateway.js");

const AXE = require("node:fs").readFileSync(require.resolve("axe-core"), "utf8");
const DRIVES = 60;
const MOST_PX = 44;
const SIZES = [[1440, 900], [820, 1000], [390, 844]];
const NAMES = ["pump", "feed-pump-house", "fan", "recirculation-blower"];

function drives() {
  return Array.from({ length: DRIVES }, (_, place) => {
    const points = { actual_speed: point(62.5, { unit: "%" }), speed_reference: point(70, { unit: "%" }), output_frequency: point(31.25, { unit: "Hz" }), motor_speed: point(912, { unit: "rpm" }),
      motor_current: point(118.4, { unit: "A" }), reversed: point(place % 5 === 0), warning: point(place === 7), fault_code: point(place === 3 ? 1 : 0) };
    const more = { 3: { state: "fault", fault_text: "overcurrent; the load jumped, or a cable has a short circuit" }, 5: { state: "offline", online: false, quality: "stale", age_ms: 61000 },
      8: { state: "ready", blocked_by: ["no_run_order"] }, 9: { state: "not_ready", blocked_by: ["local_control", "no_dc_link"] } };
    return drive(`${NAMES[place % NAMES.length]}-${place}`, { bus: `line${place % 3}`, address: place, access: "control", state: "running", points, ...more[place] });
  });
}

async function overview(gateway, page, [width, height]) {
  await page.send("Emulation.setDeviceMetricsOverride", { width, height, deviceScaleFactor: 1, mobile: width < 600 });
  plant(gateway);
  gateway.drives = drives();
  gateway.buses = ["line0", "line1", "line2"].map((name) => bus(name));
  await page.open("about:blank");
  await page.open(gateway.url);
  await page.until((count) => document.querySelectorAll(".rows .row").length === count, DRIVES);
  await logIn(gateway, page);
  await page.until(shown, ".rows .operate-stop");
}

const heights = () => [...document.querySelectorAll(".rows .row")].map((row) => {
  row.scrollIntoView({ block: "center" });
  return row.getBoundingClientRect().height;
});

async function rowsAreCompact(gateway, page) {
  for (const size of SIZES) {
    await overview(gateway, page, size);
    const all = await page.eval(heights);
    assert.equal(all.length, DRIVES);
    assert.ok(Math.max(...all) <= MOST_PX, `rows of up to ${Math.max(...all)} px at ${size[0]} px`);
    await page.eval(() => document.querySelector("[data-operate='pump-0']").closest(".row").scrollIntoView({ block: "center" }));
    // What was never on the screen has no stop yet.
    await page.until(shown, "button[aria-label='Stop pump-0']");
    const first = await page.eval(() => document.querySelector("[data-operate='pump-0']").closest(".row").innerText);
    for (const wanted of [/▶ running/, /62\.5 %\s+←/, /70\.0 %/, /118\.4 A/, /STOP/]) assert.match(first, wanted, `at ${size[0]} px`);
    assert.ok(await page.eval(() => document.documentElement.scrollWidth <= innerWidth), `nothing is wider than ${size[0]} px`);
    const cut = await page.eval(() => [...document.querySelectorAll(".rows :is(.n, .operate-stop)")].filter((each) => each.checkVisibility() && each.scrollWidth > each.clientWidth + 1).map((each) => each.textContent));
    assert.deepEqual(cut, [], `${cut.join("; ")} at ${size[0]} px`);
    const violations = await page.violations(AXE);
    assert.equal(violations.join("\n"), "", `${violations.join("\n")} at ${size[0]} px`);
  }
}

async function theHeaderOfAPhoneIsOneLine(gateway, page) {
  await overview(gateway, page, [390, 844]);
  const header = () => document.querySelector("header").getBoundingClientRect().height;
  assert.ok(await page.eval(header) <= 56, `${await page.eval(header)} px`);
  assert.ok(await page.eval(() => document.querySelector(".home b").scrollWidth <= document.querySelector(".home b").clientWidth), "the name of the gateway is cut");
  assert.equal(await page.eval(shown, "nav a"), false);
  await page.eval(click, "#menu");
  assert.equal(await page.eval(shown, "nav a[data-entry=events]"), "Events");
  assert.ok(await page.eval(header) <= 56, "the menu moves nothing");
  await page.press("Escape");
  assert.equal(await page.eval(shown, "nav a"), false);
  await page.eval(click, "#menu");
  await page.eval(click, "nav a[data-entry=lines]");
  await page.until(() => document.querySelector("h1").textContent === "Lines");
  assert.equal(await page.eval(shown, "nav a"), false, "a choice closes the menu");
}

/// A line of a name ends where a word ends.
async function namesBreakBetweenWords(gateway, page) {
  for (const size of SIZES) {
    await overview(gateway, page, size);
    const broken = await page.eval(() => [...document.querySelectorAll(".rows .name a")].filter((link) => {
      link.scrollIntoView({ block: "center" });
      const name = link.firstChild;
      const range = document.createRange();
      const topOf = (at) => {
        range.setStart(name, at);
        range.setEnd(name, at + 1);
        return range.getBoundingClientRect().top;
      };
      return [...name.data].some((letter, at) => at > 0 && name.data[at - 1] !== "-" && topOf(at) > topOf(at - 1) + 2);
    }).map((link) => link.textContent));
    assert.deepEqual(broken, [], `at ${size[0]} px`);
  }
}

async function columnsThatNoDriveFillsAreLeftOut(gateway, page) {
  await overview(gateway, page, [1440, 900]);
  const titles = () => [...document.querySelectorAll(".head [role=columnheader]")].filter((each) => each.checkVisibility()).map((each) => each.textContent);
  assert.deepEqual(await page.eval(titles), ["Drive", "State", "Speed", "Frequency", "Reference", "Motor speed", "Current", "Stop"]);
  gateway.drives[4].points.heatsink_temperature = point(41, { unit: "°C" });
  await page.until(() => [...document.querySelectorAll(".head .n")].some((each) => each.checkVisibility() && each.textContent === "Heatsink"));
  const lefts = () => [".head", ".rows .row"].map((row) => [...document.querySelector(row).children].filter((each) => each.checkVisibility()).map((each) => Math.round(each.getBoundingClientRect().right)));
  const [heads, cells] = await page.eval(lefts);
  assert.deepEqual(cells, heads, "each column stands below its title");
}

/// What is as usual has no colour; a fault, a warning and a drive that is offline have one, a sign and a word.
async function colourMeansThatSomebodyIsWanted(gateway, page) {
  await overview(gateway, page, [1440, 900]);
  const badges = await page.eval(() => Object.fromEntries([...document.querySelectorAll(".rows .row")].map((row) => {
    row.scrollIntoView({ block: "center" });
    const colours = ["backgroundColor", "color"].map((name) => getComputedStyle(row.querySelector(".badge"))[name].match(/\d+/g).map(Number));
    const isGrey = colours.every(([red, , blue]) => Math.abs(red - blue) < 25);
    return [row.querySelector(".name a").textContent, [row.querySelector(".first").innerText.trim(), isGrey]];
  })));
  assert.deepEqual(badges["pump-0"], ["▶ running", true]);
  assert.deepEqual(badges["pump-8"], ["● ready", true]);
  assert.deepEqual(badges["feed-pump-house-9"], ["◌ not ready", true]);
  assert.deepEqual(badges["recirculation-blower-3"], ["▲ fault", false]);
  assert.deepEqual(badges["feed-pump-house-5"].slice(1), [false]);
  assert.match(badges["feed-pump-house-5"][0], /✕ offline/);
  assert.equal(await page.eval(() => document.querySelector(".row.offline .second .tag").textContent), "1 min old");
  assert.match(badges["recirculation-blower-7"][0], /▶ running\s+! warning/);
}

/// While somebody points at a row, no other one takes its place.
async function rowsKeepTheirPlaceUnderThePointer(gateway, page) {
  await overview(gateway, page, [1440, 900]);
  const first = () => document.querySelector(".rows .name a").textContent;
  assert.equal(await page.eval(first), "recirculation-blower-3");
  const { x, y } = await page.eval(() => {
    window.scrollTo(0, 0);
    const { x, y, width, height } = document.querySelector(".rows .operate-stop").getBoundingClientRect();
    return { x: x + width / 2, y: y + height / 2 };
  });
  await page.send("Input.dispatchMouseEvent", { type: "mouseMoved", x, y });
  Object.assign(gateway.drives[1], { state: "fault", fault_text: "undervoltage" });
  await page.until(() => document.querySelectorAll(".rows .fault").length === 2);
  assert.equal(await page.eval(first), "recirculation-blower-3");
  for (const type of ["mousePressed", "mouseReleased"]) await page.send("Input.dispatchMouseEvent", { type, x, y, button: "left", clickCount: 1 });
  await page.until(told, "Stop: confirmed");
  assert.deepEqual(gateway.commands, [{ run: false }]);
  assert.equal(await page.eval(() => [...document.querySelectorAll(".notice")].filter((each) => each.textContent).map((each) => each.closest(".row").querySelector(".name a").textContent).join()), "recirculation-blower-3");
  await page.send("Input.dispatchMouseEvent", { type: "mouseMoved", x: 5, y: 5 });
  await page.until(() => document.querySelector(".rows .name a").textContent === "feed-pump-house-1");
}

/// The result of a stop can be read in the row of a phone, next to the state of the drive.
async function resultsAreReadOnAPhone(gateway, page) {
  await overview(gateway, page, [390, 844]);
  const running = () => [...document.querySelectorAll(".rows .row")].find((row) => row.className.includes("running"));
  await page.eval(`(${running})().querySelector(".operate-stop").click()`);
  await page.until(told, "Stop: confirmed");
  const { height, state, seen } = await page.eval(`(() => {
    const row = (${running})();
    const range = document.createRange();
    const text = row.querySelector(".notice").firstChild;
    range.setStart(text, 0);
    range.setEnd(text, "Stop: confirmed".length);
    return { height: row.getBoundingClientRect().height, state: row.querySelector(".badge").innerText, seen: range.getBoundingClientRect().right < row.querySelector(".second").getBoundingClientRect().right };
  })()`);
  assert.equal(state, "▶ running");
  assert.ok(seen, "the result is cut off");
  assert.ok(height <= MOST_PX, `${height} px`);
}

/// "All drives have stopped" informs and does not warn.
async function stoppedIsInformation(gateway, page) {
  await overview(gateway, page, [1440, 900]);
  gateway.obey = () => [200, { ok: true, drives: gateway.drives.map(({ name }) => ({ drive: name, outcome: "standing", reason: "" })) }];
  await page.eval(click, "#stop-all");
  await page.eval(click, "#stops .operate-stop");
  await page.until(() => document.getElementById("stops").innerText.includes("All drives have stopped: 60 of 60"));
  const [role, red, blue] = await page.eval(() => {
    const bar = document.querySelector("#stops .not-stopped");
    const [red, , blue] = getComputedStyle(bar).backgroundColor.match(/\d+/g).map(Number);
    return [bar.querySelector("p").getAttribute("role"), red, blue];
  });
  assert.equal(role, "status");
  assert.ok(Math.abs(red - blue) < 25, "grey");
  await page.press("Escape");
  assert.equal(await page.eval(() => document.getElementById("stops").innerText), "");
}

run([stoppedIsInformation, resultsAreReadOnAPhone, rowsAreCompact, theHeaderOfAPhoneIsOneLine, namesBreakBetweenWords, columnsThatNoDriveFillsAreLeftOut, colourMeansThatSomebodyIsWanted, rowsKeepTheirPlaceUnderThePointer]);
