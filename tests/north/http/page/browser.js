"use strict";
// Chromium, driven over the pipe of its DevTools protocol: pages of a given size and colour scheme, keys, figures, pictures.
const fs = require("node:fs");
const os = require("node:os");
const path = require("node:path");
const { spawn } = require("node:child_process");

const PATIENCE_MS = Number(process.env.PATIENCE_MS ?? 120000);
const FLAGS = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
  "--disable-component-update", "--disable-sync", "--hide-scrollbars", "--force-color-profile=srgb", "--remote-debugging-pipe"];
const KEYS = { Tab: 9, Enter: 13, Escape: 27, " ": 32, Home: 36, End: 35, ArrowLeft: 37, ArrowRight: 39 };
const TYPES = { Enter: "\r", " ": " " };

class Browser {
  constructor() {
    this.profile = fs.mkdtempSync(path.join(os.tmpdir(), "drivegate-chromium-"));
    // Its own temporary files are removed with the profile, however this process ends.
    const env = { ...process.env, TMPDIR: this.profile };
    this.child = spawn("chromium", [...FLAGS, `--user-data-dir=${this.profile}`], { env, stdio: ["ignore", "ignore", "ignore", "pipe", "pipe"] });
    process.on("exit", () => {
      this.child.kill("SIGKILL");
      // Its children write for a moment longer.
      fs.rmSync(this.profile, { recursive: true, force: true, maxRetries: 50, retryDelay: 100 });
    });
    this.child.on("error", (error) => this.fail(new Error(`${error.message}: is Debian's package chromium installed?`)));
    this.child.on("exit", (code) => this.fail(new Error(`Chromium ended with ${code}`)));
    this.waiting = new Map();
    this.listeners = new Map();
    this.last = 0;
    let rest = [];
    this.child.stdio[4].on("data", (bytes) => {
      for (let end = bytes.indexOf(0); end >= 0; end = bytes.indexOf(0)) {
        this.message(JSON.parse(Buffer.concat([...rest, bytes.subarray(0, end)]).toString()));
        rest = [];
        bytes = bytes.subarray(end + 1);
      }
      rest.push(bytes);
    });
  }

  message({ id, method, params, error, result, sessionId }) {
    const waits = this.waiting.get(id);
    this.waiting.delete(id);
    if (waits && error) waits.reject(new Error(`${waits.method}: ${error.message}`));
    else if (waits) waits.resolve(result);
    else this.listeners.get(sessionId)?.(method, params);
  }

  fail(error) {
    this.failure = error;
    for (const { reject } of this.waiting.values()) reject(error);
    this.waiting.clear();
  }

  send(method, params = {}, sessionId) {
    if (this.failure) return Promise.reject(this.failure);
    const id = ++this.last;
    this.child.stdio[3].write(`${JSON.stringify({ id, method, params, sessionId })}\0`);
    return new Promise((resolve, reject) => this.waiting.set(id, { resolve, reject, method }));
  }

  /// A page of that width; it shows nothing yet.
  async page({ width = 1400, height = 900, dark = false, calm = true, language = "en-US" } = {}) {
    const { targetId } = await this.send("Target.createTarget", { url: "about:blank" });
    const { sessionId } = await this.send("Target.attachToTarget", { targetId, flatten: true });
    const page = new Page(this, sessionId, targetId);
    await page.send("Page.enable");
    await page.send("Runtime.enable");
    await page.send("Log.enable");
    await page.send("Emulation.setDeviceMetricsOverride", { width, height, deviceScaleFactor: 1, mobile: width < 600 });
    await page.send("Emulation.setUserAgentOverride", { userAgent: "test", acceptLanguage: language });
    const features = [["prefers-color-scheme", dark ? "dark" : "light"], ["prefers-reduced-motion", calm ? "reduce" : "no-preference"]];
    await page.send("Emulation.setEmulatedMedia", { features: features.map(([name, value]) => ({ name, value })) });
    return page;
  }

  async close() {
    const ended = new Promise((resolve) => this.child.once("exit", resolve));
    await this.send("Browser.close").catch(() => this.child.kill("SIGKILL"));
    await ended;
    fs.rmSync(this.profile, { recursive: true, force: true, maxRetries: 20, retryDelay: 100 });
  }
}

class Page {
  constructor(browser, session, target) {
    Object.assign(this, { browser, session, target, problems: [] });
    browser.listeners.set(session, (method, params) => {
      if (method === "Runtime.exceptionThrown") this.problems.push(params.exceptionDetails.exception?.description ?? params.exceptionDetails.text);
      if (method === "Log.entryAdded" && params.entry.level === "error") this.problems.push(`${params.entry.text} ${params.entry.url ?? ""}`);
      if (method === "Runtime.consoleAPICalled" && params.type === "error") this.problems.push(params.args.map((arg) => arg.value).join(" "));
    });
  }

  send(method, params) {
    return this.browser.send(method, params, this.session);
  }

  async open(url) {
    await this.send("Page.navigate", { url });
  }

  /// The value of an expression; a function is called in the page with the arguments.
  async eval(code, ...args) {
    const expression = typeof code === "function" ? `(${code})(...${JSON.stringify(args)})` : code;
    const { result, exceptionDetails } = await this.send("Runtime.evaluate", { expression, awaitPromise: true, returnByValue: true });
    if (exceptionDetails) throw new Error(exceptionDetails.exception?.description ?? exceptionDetails.text);
    return result.value;
  }

  /// Waits until the function returns something in the page.
  async until(code, ...args) {
    const end = Date.now() + PATIENCE_MS;
    for (;;) {
      // A page that is just being replaced by another can answer nothing.
      const found = await this.eval(code, ...args).catch((error) => {
        if (!/context/.test(error.message)) throw error;
      });
      if (found) return found;
      if (Date.now() > end) throw new Error(`waited for ${code} ${JSON.stringify(args)} in\n${await this.eval("document.body.innerText")}\n${this.problems.join("\n")}`);
      await new Promise((resolve) => setTimeout(resolve, 50));
    }
  }

  /// What axe-core, the source of which is `axe`, finds in the page. On a busy machine a connection may be lost, which greys the
  /// page: it is looked at again then.
  async violations(axe) {
    if (!(await this.eval("Boolean(window.axe)"))) await this.eval(`${axe}; true`);
    for (;;) {
      await this.until(() => !document.body.classList.contains("lost"));
      const { lost, found } = await this.eval(async () => {
        let lost = false;
        const watcher = new MutationObserver(() => (lost ||= document.body.classList.contains("lost")));
        watcher.observe(document.body, { attributes: true, attributeFilter: ["class"] });
        const { violations } = await window.axe.run(document, { resultTypes: ["violations"] });
        watcher.disconnect();
        const shown = (node) => `${node.html.slice(0, 200)} ${node.any.concat(node.all, node.none).map((each) => each.message).join("; ")}`;
        const found = violations.map(({ id, help, nodes }) => `${id}: ${help}: ${nodes.slice(0, 3).map(shown).join("\n")}`);
        return { lost: lost || document.body.classList.contains("lost"), found };
      });
      if (!lost || found.length === 0) return found;
    }
  }

  /// The key goes down, or its repetition while it is held.
  async keyDown(key, autoRepeat = false) {
    await this.send("Input.dispatchKeyEvent", { type: "keyDown", key, code: key, windowsVirtualKeyCode: KEYS[key], text: TYPES[key], autoRepeat });
  }

  async keyUp(key) {
    await this.send("Input.dispatchKeyEvent", { type: "keyUp", key, code: key, windowsVirtualKeyCode: KEYS[key] });
  }

  async press(key) {
    await this.keyDown(key);
    await this.keyUp(key);
  }

  async type(text) {
    await this.send("Input.insertText", { text });
  }

  /// From now on an answer takes that long to come, ms.
  async slow(latency) {
    await this.send("Network.enable");
    await this.send("Network.emulateNetworkConditions", { offline: false, latency, downloadThroughput: -1, uploadThroughput: -1 });
  }

  /// What the browser spent so far, in seconds: LayoutDuration, RecalcStyleDuration, TaskDuration.
  async spent() {
    await this.send("Performance.enable", { timeDomain: "threadTicks" });
    const { metrics } = await this.send("Performance.getMetrics");
    return Object.fromEntries(metrics.map(({ name, value }) => [name, value]));
  }

  /// Runs `meanwhile`; the time that scripts and the collection of their garbage took, ms, by the browser's profiler.
  async profile(meanwhile) {
    await this.send("Profiler.enable");
    await this.send("Profiler.setSamplingInterval", { interval: 200 });
    await this.send("Profiler.start");
    await meanwhile();
    const { profile } = await this.send("Profiler.stop");
    const idle = new Set(profile.nodes.filter(({ callFrame }) => ["(idle)", "(program)", "(root)"].includes(callFrame.functionName)).map(({ id }) => id));
    return profile.samples.reduce((sum, id, place) => sum + (idle.has(id) ? 0 : Math.max(0, profile.timeDeltas[place])), 0) / 1000;
  }

  /// A PNG of what is shown, or of the whole page.
  async picture(whole = false) {
    const { data } = await this.send("Page.captureScreenshot", { format: "png", captureBeyondViewport: whole });
    return Buffer.from(data, "base64");
  }

  async close() {
    await this.browser.send("Target.closeTarget", { targetId: this.target });
  }
}

module.exports = { Browser };
