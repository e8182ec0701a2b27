"use strict";
// Writes the pictures of the documentation. Arguments: the address of the gateway, the directory.
const assert = require("node:assert");
const fs = require("node:fs");
const path = require("node:path");
const { Browser } = require("./browser.js");

// Name, size, colours, address, and a sign that it is complete.
const pictures = (recording) => [
  ["overview", 1400, 860, false, "#/", ".rows .row"],
  ["drive", 1400, 1000, false, "#/drive/pump-1", ".curve"],
  ["recording", 1400, 1080, true, `#/recording/${recording}`, ".curve"],
  ["line", 1400, 1000, false, "#/line/line1", ".strip .minutes rect"],
  ["phone", 400, 800, true, "#/", ".rows .row"],
];

async function main() {
  const [base, dir] = process.argv.slice(2);
  const [{ id }] = await (await fetch(`${base}api/v1/recordings`)).json();
  fs.mkdirSync(dir, { recursive: true });
  const browser = new Browser();
  for (const [name, width, height, dark, hash, sign] of pictures(id)) {
    const page = await browser.page({ width, height, dark });
    await page.open(`${base}${hash}`);
    await page.until((sign) => document.querySelector("#live:not([hidden])") && document.querySelector(sign), sign);
    if (name === "recording") await page.eval(() => [...document.querySelectorAll(".choices button")].find((button) => button.textContent === "10 s").click());
    // A second answer: rates need two.
    await page.until(() => performance.getEntriesByType("resource").filter((entry) => entry.name.includes("/api/v1/buses")).length > 2 || !document.querySelector(".card, .top"));
    const problems = page.problems.filter((problem) => !problem.includes("/diagnosis"));
    assert.deepEqual(problems, [], name);
    fs.writeFileSync(path.join(dir, `${name}.png`), await page.picture());
    await page.close();
  }
  await browser.close();
}

main().catch((error) => {
  console.error(error);
  process.exit(1);
});
