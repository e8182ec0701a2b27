"use strict";
// A gateway that says what a test wants: the files of the page, and replies that the test changes while the page looks on.
const fs = require("node:fs");
const http = require("node:http");
const path = require("node:path");

const FILES = path.join(__dirname, "../../../../crates/http/src/page");
const TYPES = { ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml" };
const POLICY = /SECURITY_POLICY: &str = "((?:[^"\\]|\\\s)*)"/.exec(fs.readFileSync(path.join(FILES, "mod.rs"), "utf8"))[1].replace(/\\\s+/g, "");

const HEAD = /OPERATE_HEAD: &str = "((?:[^"\\]|\\[\s\S])*)"/.exec(fs.readFileSync(path.join(FILES, "mod.rs"), "utf8"))[1].replace(/\\n|\\\s+/g, "").replace(/\\"/g, '"');

const point = (value, more = {}) => ({ value, quality: "good", unit: "", age_ms: 10, time: "2026-03-02T07:40:12.118Z", ...more });

function drive(name, more = {}) {
  return { name, bus: "line1", address: 1, unit: 1, profile: "p", access: "monitor", state: "ready", quality: "good", online: true, age_ms: 10,
    fault_text: "", blocked_by: [], why: [], turnaround_ms: 1.9, transactions: { ok: 10, exception: 0, timeout: 0, corrupt: 0 }, starts: 3,
    running_seconds: 7260, energy_kwh: null, points: {}, ...more };
}

function bus(name, more = {}) {
  return { name, port: "/dev/ttyUSB0", protocol: "modbus-rtu", baud: 9600, format: "8N1", state: "up", tried: true, drives: 1, online: 1, load_ratio: 0.5,
    fast: { aim_ms: 100, cycle_ms: 100, rounds: 9 }, slow: { aim_ms: 1000, cycle_ms: 1000, rounds: 1 }, transactions: 10, errors: 0, queue_depth: 0, ...more };
}

const ended = (count) => new Date(Date.now() - count * 1000).toISOString();

/// `before` is a time in seconds, or the number of an event.
const isBefore = ({ id, time }, before) => (before.includes("-") ? id < Number(before.split("-")[1]) : Date.parse(time) < 1000 * Number(before));

class FakeGateway {
  constructor() {
    Object.assign(this, { drives: [], buses: [bus("line1")], events: [], recordings: {}, audit: [], trends: {}, diagnosis: null, mqtt: { links: [], waiting: 0, published: 0, lost: 0 }, asked: [] });
    // Of a gateway that takes commands: who is logged in, what can be commanded, what was, and the answer to it, which may have to wait.
    Object.assign(this, { operating: false, session: null, about: null, commands: [], obey: () => [200, { result: "confirmed", confirmed_ms: 20 }], wait: null });
    this.server = http.createServer((request, response) => this.answer(request, response));
  }

  start() {
    return new Promise((resolve) => this.server.listen(0, "127.0.0.1", () => resolve(`http://127.0.0.1:${this.server.address().port}/`)));
  }

  stop() {
    this.server.closeAllConnections();
    return new Promise((resolve) => this.server.close(resolve));
  }

  answer(request, response) {
    const url = new URL(request.url, "http://localhost");
    this.asked.push(request.url);
    if (this.silent) return;
    if (url.pathname === "/") return this.file(response, "index.html", "text/html");
    if (url.pathname.startsWith("/assets/")) return this.file(response, path.basename(url.pathname), TYPES[path.extname(url.pathname)]);
    if (request.method === "POST") return this.post(url, request, response);
    const reply = this.reply(url);
    const found = reply !== undefined;
    response.writeHead(found ? 200 : 404, { "content-type": "application/json" });
    response.end(JSON.stringify(found ? reply : { error: `there is nothing at ${url.pathname}`, known: this.drives.map(({ name }) => name) }));
  }

  async post(url, request, response) {
    let body = "";
    for await (const part of request) body += part;
    await this.wait;
    const [status, json] = this.posted(url.pathname, body && JSON.parse(body), request.headers["x-csrf-token"]);
    response.writeHead(status, { "content-type": "application/json" });
    response.end(status === 204 ? undefined : JSON.stringify(json));
  }

  posted(path, body, csrf) {
    if (path === "/api/v1/login") {
      this.session = { user: body.user, csrf: "token 1", expires_in: 1800 };
      return [200, this.session];
    }
    if (path === "/api/v1/logout") return [204, (this.session = null)];
    if (!this.session) return [401, { error: "the session has ended; log in again" }];
    if (csrf !== this.session.csrf) return [403, { error: "the header X-CSRF-Token does not have the token of this session" }];
    if (path.endsWith("/heartbeat")) return [204];
    const { id, ...points } = body;
    this.commands.push(points);
    return this.obey(points);
  }

  file(response, name, type) {
    const head = this.operating ? HEAD : "";
    const text = fs.readFileSync(path.join(FILES, name), "utf8").replace(/\{\{gateway\}\}/g, "test").replace("{{operate}}", head).replace(/\{\{\w+\}\}/g, "");
    response.writeHead(200, { "content-type": `${type}; charset=utf-8`, "content-security-policy": POLICY });
    response.end(text);
  }

  reply(url) {
    const [kind, name, part] = url.pathname.replace("/api/v1/", "").split("/").map(decodeURIComponent);
    const one = this.drives.find((drive) => drive.name === name);
    if (kind === "session") return this.session ?? { user: null };
    if (kind === "drives" && part === "commands") return this.about;
    if (kind === "drives" && part === "trend") return one && this.trend(one, url.searchParams.get("point"));
    if (kind === "drives") return name ? one : this.drives;
    if (kind === "buses" && part === "diagnosis") return this.diagnosis ?? undefined;
    if (kind === "buses") return name ? this.line(name) : this.buses;
    if (kind === "events") return this.search(url.searchParams);
    if (kind === "recordings") return name ? this.recordings[name] : Object.values(this.recordings).map((recording) => recording.entry);
    if (kind === "audit") return this.audit;
    if (kind === "mqtt") return this.mqtt;
    return undefined;
  }

  search(wanted) {
    const matches = (event) => ["drive", "bus"].every((name) => !wanted.get(name) || event[name] === wanted.get(name)) &&
      (!wanted.get("kind") || event.event === wanted.get("kind")) && (!wanted.get("text") || event.text.includes(wanted.get("text"))) &&
      (!wanted.get("before") || isBefore(event, wanted.get("before")));
    return this.events.filter(matches).slice(0, Number(wanted.get("limit")));
  }

  trend({ name }, points) {
    if (!points) return { drive: name, ranges: [], points: Object.keys(this.trends).map((point) => ({ point, unit: this.trends[point].unit })) };
    const replies = points.split(",").map((point) => {
      const { unit, samples } = this.trends[point];
      return { drive: name, point, unit, step_s: 1, from: ended(samples.length), to: ended(0), samples: samples.map((value, at) => value && [Date.now() - (samples.length - at) * 1000, ...value]) };
    });
    return replies.length === 1 ? replies[0] : replies;
  }

  line(name) {
    const found = this.buses.find((bus) => bus.name === name);
    const members = this.drives.filter((drive) => drive.bus === name);
    const none = Array(60).fill(null);
    return found && { ...found, turnaround: { le_ms: [1, 2, 5, null], counts: [0, 7, 3, 0], count: 10, sum_ms: 20 },
      hour: { from: ended(3600), step_s: 60, load_ratio: none, fast_cycle_ms: none },
      by_drive: members.map(({ name }) => ({ drive: name, address: 1, errors: [...none.slice(1), 4] })) };
  }
}

module.exports = { FakeGateway, drive, point, bus };
