"use strict";
// Operates a drive from the status page in Chromium, as a person does: by what is seen and by the keyboard.
// Arguments: the URL of the gateway, the script of axe-core, and what to do.
const assert = require("node:assert");
const { spawn } = require("node:child_process");
const fs = require("node:fs");
const os = require("node:os");
const path = require("node:path");

const [url, axe, what] = process.argv.slice(2);
const PATIENCE_MS = 200000;

// The browser's own protocol over two pipes.
class Browser {
  constructor() {
    this.profile = fs.mkdtempSync(path.join(os.tmpdir(), "operate-"));
    const options = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
      "--disable-component-update", "--disable-sync", `--user-data-dir=${this.profile}`, "--remote-debugging-pipe", "about:blank"];
    const env = { ...process.env, TMPDIR: this.profile };
    this.process = spawn("chromium", options, { env, stdio: ["ignore", "ignore", "ignore", "pipe", "pipe"] });
    this.waiting = new Map();
    this.number = 0;
    this.messages = [];
    let rest = "";
    this.process.stdio[4].on("data", (data) => {
      const texts = (rest + data).split("\0");
      rest = texts.pop();
      for (const message of texts.map((text) => JSON.parse(text))) {
        const waiting = this.waiting.get(message.id);
        if (waiting) (message.error ? waiting.reject(new Error(JSON.stringify(message.error))) : waiting.resolve(message.result));
        else if (message.method === "Log.entryAdded" || message.method === "Runtime.exceptionThrown") this.messages.push(JSON.stringify(message.params));
      }
    });
  }

  call(method, params = {}) {
    const id = ++this.number;
    this.process.stdio[3].write(JSON.stringify({ id, method, params, sessionId: this.session }) + "\0");
    return new Promise((resolve, reject) => this.waiting.set(id, { resolve, reject }));
  }

  async open(address) {
    const { targetId } = await this.call("Target.createTarget", { url: "about:blank" });
    this.session = (await this.call("Target.attachToTarget", { targetId, flatten: true })).sessionId;
    for (const domain of ["Page", "Runtime", "Log"]) await this.call(`${domain}.enable`);
    await this.call("Page.navigate", { url: address });
  }

  async run(expression) {
    const { result, exceptionDetails } = await this.call("Runtime.evaluate", { expression, awaitPromise: true, returnByValue: true });
    if (exceptionDetails) throw new Error(`${expression}: ${JSON.stringify(exceptionDetails)}`);
    return result.value;
  }

  async until(about, expression) {
    const end = Date.now() + PATIENCE_MS;
    for (;;) {
      const value = await this.run(`(() => { try { return ${expression}; } catch { return false; } })()`);
      if (value) return value;
      if (Date.now() > end) throw new Error(`never came: ${about}\n${this.messages.join("\n")}\n${await this.run("document.body.innerText")}`);
      await new Promise((done) => setTimeout(done, 50));
    }
  }

  async key(key, text) {
    const code = { Tab: 9, Enter: 13 }[key];
    const event = { key, code: key, windowsVirtualKeyCode: code, text };
    await this.call("Input.dispatchKeyEvent", { type: text ? "keyDown" : "rawKeyDown", ...event });
    await this.call("Input.dispatchKeyEvent", { type: "keyUp", ...event });
  }

  write(text) {
    return this.call("Input.insertText", { text });
  }

  // Goes on with the tabulator until the element has the focus.
  async tabTo(selector) {
    for (let pressed = 0; pressed < 200; pressed += 1) {
      if (await this.run(`document.activeElement?.matches(${JSON.stringify(selector)}) ?? false`)) return;
      await this.key("Tab");
    }
    throw new Error(`the keyboard does not reach ${selector}`);
  }

  async press(selector) {
    await this.tabTo(selector);
    await this.key("Enter", "\r");
  }

  // Asks, and answers. A question ends where the state of the drive changes, which on a busy machine a late value does: then it is
  // asked again.
  async answer(question, answer) {
    for (let time = 0; ; time += 1) {
      await this.press(question);
      try {
        return await this.press(answer);
      } catch (error) {
        if (time === 19) throw error;
      }
    }
  }

  async close() {
    this.process.kill();
    await new Promise((done) => this.process.on("exit", done));
    // Children of the browser write for a moment longer.
    for (let left = 100; fs.existsSync(this.profile); left -= 1) {
      try {
        fs.rmSync(this.profile, { recursive: true, force: true });
      } catch (error) {
        if (left === 0) throw error;
        await new Promise((done) => setTimeout(done, 100));
      }
    }
  }
}

const seen = (selector) => `document.querySelector(${JSON.stringify(selector)})?.checkVisibility()`;
const result = (words) => `document.querySelector(".operate .operate-result").textContent.includes(${JSON.stringify(words)})`;
const stopButton = "button[aria-label='Stop pump-1']";

async function accessible(browser, state) {
  await browser.run(fs.readFileSync(axe, "utf8"));
  const violations = await browser.run("axe.run(document, { resultTypes: ['violations'] }).then((r) => JSON.stringify(r.violations.map((v) => [v.id, v.nodes.map((n) => n.html)])))");
  assert.strictEqual(violations, "[]", state);
}

async function logIn(browser, password) {
  await browser.until("the login", seen("#login .login-open"));
  if (!(await browser.run(seen("#login-fold input[name=user]")))) await browser.press("#login .login-open");
  await browser.tabTo("#login-fold input[name=user]");
  await browser.write("alice");
  await browser.tabTo("#login-fold input[name=password]");
  await browser.write(password);
  await browser.key("Enter", "\r");
}

async function operate(browser) {
  await browser.until("the drives", "document.body.innerText.includes('pump-1')");
  assert.strictEqual(await browser.run("document.querySelectorAll('.operate button').length"), 0, "nothing to press before the login");
  await accessible(browser, "before the login");
  await logIn(browser, "wrong horse!");
  await browser.until("a refusal", "document.querySelector('#login-fold .operate-result').textContent.includes('wrong user or password')");
  await browser.run("document.querySelector('#login-fold input[name=user]').value = ''");
  await logIn(browser, "correct horse");
  await browser.until("the login is shown", "document.querySelector('.login-known').innerText.includes('alice')");
  await browser.until("the stop button", seen(stopButton));
  assert.strictEqual(await browser.run("document.querySelectorAll('.operate .operate-stop').length"), 1, "fan-2 is only monitored");
  // The row has the stop, the page of the drive the rest.
  await browser.press(".rows a[href='#/drive/pump-1']");
  await browser.until("the limits", "document.querySelector('.operate-reference').innerText.includes('from 0 to 80 %')");
  await accessible(browser, "after the login");
  // A reference outside the limits is not sent, one inside is.
  await browser.tabTo(".operate-reference input");
  await browser.write("90");
  await browser.key("Enter", "\r");
  await browser.until("the limits are told", result("nothing was sent"));
  await browser.run("document.querySelector('.operate-reference input').value = ''");
  await browser.write("50");
  await browser.key("Enter", "\r");
  await browser.until("the reference", result("Reference 50 %: confirmed"));
  // Start asks first, and the stop can be pressed while it asks.
  await browser.press("button[aria-label='Start pump-1']");
  await browser.until("the question", seen(".operate-confirm"));
  assert.ok(await browser.run(seen(stopButton)));
  await accessible(browser, "while it asks");
  try {
    await browser.press("button[aria-label='Cancel: do not start pump-1']");
  } catch (error) {
    if (await browser.run(seen(".operate-confirm"))) throw error;
  }
  // A question that ended by a late value says that nothing was sent.
  assert.ok(await browser.run(`${result("Reference 50 %")} || ${result("nothing was sent")}`), "something was sent");
  await browser.answer("button[aria-label='Start pump-1']", "button[aria-label='Start now: pump-1']");
  await browser.until("the start", result("Start forward: confirmed"));
  await browser.until("it runs", "document.querySelector('.top .badge').textContent.includes('running')");
  // The lease of 8 s is renewed while the person is active.
  for (let turn = 0; turn < 24; turn += 1) {
    await browser.key("Tab");
    await new Promise((done) => setTimeout(done, 500));
  }
  // A drive that was stopped does not start by itself; a late value shows no state for a moment.
  await browser.until("it runs still: its lease was renewed", "document.querySelector('.top .badge').textContent.includes('running')");
  await browser.until("who supervises", "document.querySelector('.operate-lease').textContent.includes('Supervised by this page')");
  await browser.press(stopButton);
  await browser.until("the stop", result("Stop: "));
  await browser.until("it stands", "!document.querySelector('.top .badge').textContent.includes('running')");
  // All drives at once: asked back once, and told when they stand.
  await browser.answer("button[aria-label='Start pump-1']", "button[aria-label='Start now: pump-1']");
  await browser.until("it runs again", "document.querySelector('.top .badge').textContent.includes('running')");
  await browser.press("#stop-all");
  await browser.until("the question", seen("#stops .operate-stop"));
  await accessible(browser, "while stop all asks");
  // The question ends by itself after a time, which a busy machine needs for that check.
  try {
    await browser.press("#stops .operate-button");
  } catch {
    await browser.answer("#stop-all", "#stops .operate-button");
  }
  await browser.until("it runs still: nothing was stopped", "document.querySelector('.top .badge').textContent.includes('running')");
  await browser.answer("#stop-all", "#stops .operate-stop");
  await browser.until("all stand", "document.getElementById('stops').innerText.includes('All drives have stopped: 1 of 1')");
  await browser.until("it stands", "!document.querySelector('.top .badge').textContent.includes('running')");
  await browser.press("#stops .operate-button");
  assert.strictEqual(await browser.run("document.getElementById('stops').innerText"), "");
  await browser.press("#login .login-known button");
  await browser.until("the logout", seen("#login .login-open"));
  assert.strictEqual(await browser.run("document.querySelectorAll('.operate button').length"), 0, "nothing to press after the logout");
  assert.ok(!(await browser.run(seen("#stop-all"))), "nor all drives");
}

// A drive that runs is stopped in a page whose session ended: the page says what happened.
async function ended(browser) {
  await logIn(browser, "correct horse");
  await browser.until("the stop button", seen(stopButton));
  // Nobody looks after the session until the stop is pressed.
  await browser.call("Network.enable");
  await browser.call("Network.setBlockedURLs", { urls: ["*/api/v1/session"] });
  process.stdout.write("logged in\n");
  await new Promise((done) => process.stdin.once("data", done));
  await browser.tabTo(stopButton);
  await browser.call("Network.setBlockedURLs", { urls: [] });
  await browser.key("Enter", "\r");
  await browser.until("the end", "document.querySelector('#login-fold .operate-result').textContent.includes('The session has ended')");
  await browser.until("the banner", "document.getElementById('stops').innerText.includes('pump-1 was not stopped')");
  assert.strictEqual(await browser.run("document.querySelectorAll('.operate button').length"), 0);
}

(async () => {
  const browser = new Browser();
  try {
    await browser.open(url);
    await { operate, ended }[what](browser);
    const complaints = browser.messages.filter((text) => !/status of (401|403|409|422)|ERR_BLOCKED_BY_CLIENT/.test(text));
    assert.deepStrictEqual(complaints, [], "the browser complains of nothing");
  } finally {
    await browser.close();
  }
  process.exit(0);
})().catch((error) => {
  console.error(error);
  process.exit(1);
});
