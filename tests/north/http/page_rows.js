"use strict";
// The rows of the status page over a reload, with as much of a document as its script needs. Argument: the script.
const assert = require("node:assert");
const fs = require("node:fs");
const vm = require("node:vm");

class Element {
  constructor(tag) {
    Object.assign(this, { tag, children: [], own: "", className: "", hidden: false, dataset: {}, style: {}, attributes: {}, parentElement: null });
    this.classList = { toggle() {} };
  }
  append(...children) {
    for (const child of children) {
      const element = typeof child === "string" ? Object.assign(new Element("#text"), { own: child }) : child;
      element.parentElement = this;
      this.children.push(element);
    }
  }
  prepend(child) { this.append(child); }
  remove() { this.parentElement.children = this.parentElement.children.filter((child) => child !== this); }
  get lastChild() { return this.children[this.children.length - 1]; }
  get textContent() { return this.own + this.children.map((child) => child.textContent).join(""); }
  set textContent(value) { this.own = value; this.children = []; }
  set title(value) { this.attributes.title = value; }
  setAttribute(name, value) { this.attributes[name] = value; }
  removeAttribute(name) { delete this.attributes[name]; }
  addEventListener(kind, listener) { this.attributes[kind] = listener; }
  find(test) { return test(this) ? this : this.children.map((child) => child.find(test)).find(Boolean); }
}

const byId = new Map();
const document = {
  hidden: true, body: new Element("body"), addEventListener() {}, createElement: (tag) => new Element(tag), querySelector: () => new Element("dd"),
  getElementById: (id) => byId.get(id) ?? byId.set(id, new Element(id)).get(id),
};
const page = vm.createContext({ document, performance, setTimeout() {}, clearTimeout() {}, setInterval() {}, console });
vm.runInContext(fs.readFileSync(process.argv[2], "utf8"), page);

const point = (value, more = {}) => ({ value, quality: "good", unit: "", age_ms: 10, ...more });
const drive = (points, more = {}) => ({ name: "fan-1", bus: "line1", address: 1, profile: "p", state: "ready", quality: "good", age_ms: 10, fault_text: "", blocked_by: [], why: [], points, ...more });

const row = page.driveRow("fan-1");
page.showDrive(row, drive({ hand_auto: point(false, { text: "hand" }), old_point: point(7) }));
row.open.attributes.click();
const shown = () => row.list.textContent;
assert.match(shown(), /hand autohand/, "the text of the enumeration");
assert.match(shown(), /old point7/);

page.showDrive(row, drive({ hand_auto: point(true, { text: "auto" }), new_point: point(8) }));
assert.match(shown(), /hand autoauto/);
assert.match(shown(), /new point8/);
assert.doesNotMatch(shown(), /old point/, "a point of the profile that a reload replaced");

const cell = (title) => row.cells.find((cell) => cell.td.dataset.title === title);
page.showDrive(row, drive({ output_frequency: point(0, { unit: "Hz" }), motor_speed: point(1290, { unit: "rpm", age_ms: 900, contradicted: true }) }));
assert.equal(cell("Frequency").age.textContent, "");
assert.equal(cell("Motor").age.textContent, "900 ms old");
assert.equal(cell("Motor").value.className, "value contradicted");
assert.match(cell("Motor").value.attributes.title, /a newer state says otherwise/);

const cause = { cause: "interlocked", evidence: "interlocked is on", age_ms: 140, remedy: "close it" };
page.showDrive(row, drive({}, { blocked_by: ["interlocked", "fault"], why: [cause] }));
assert.equal(row.blocked.textContent, "interlocked");
assert.equal(row.causes.textContent, "interlocked: interlocked is on (140 ms ago). What to do: close it.");
page.showDrive(row, drive({}));
assert.equal(row.blocked.hidden && row.causes.hidden, true);
