// A daemon with its page, in a temporary folder, and functions that write frames there.

const fs = require("fs");
const path = require("path");
const { spawn } = require("child_process");

const PATIENCE_MS = 300_000;

/** Waits until `is` gives something; it is asked again and again. */
async function until(what, is, patienceMs = PATIENCE_MS) {
  const end = Date.now() + patienceMs;
  for (;;) {
    const found = await is();
    if (found) return found;
    if (Date.now() > end) throw new Error(`waited in vain: ${what}`);
    await new Promise((done) => setTimeout(done, 50));
  }
}

class Watching {
  /** Starts `meniscus watch` with these options on the subfolder `in` of an empty folder. */
  static async start(program, folder, options) {
    fs.mkdirSync(path.join(folder, "in"), { recursive: true });
    const watching = new Watching();
    Object.assign(watching, { program, folder, options });
    await watching.begin("127.0.0.1:0");
    return watching;
  }

  /** Starts the daemon with its page at this address, and waits until it is ready. */
  async begin(listen) {
    this.log = "";
    const words = ["watch", "in", "--out", "out", "--listen", listen, ...this.options];
    this.child = spawn(this.program, words, { cwd: this.folder, stdio: ["ignore", "ignore", "pipe"] });
    this.child.stderr.on("data", (text) => (this.log += text));
    const found = await until("the server starts", () => {
      if (this.child.exitCode !== null) throw new Error(this.log);
      return this.log.match(/http:\/\/127\.0\.0\.1:\d+/);
    });
    this.address = `${found[0]}/`;
    await until("the daemon is ready", async () => (await fetch(`${this.address}readyz`)).ok);
  }

  /** Stops the daemon, and starts a new one at the same address. */
  async restart() {
    await this.stop();
    await this.begin(new URL(this.address).host);
  }

  /** Writes a frame next to the watched folder, and renames it into this folder. */
  put(name, bytes) {
    const [beside, target] = [path.join(this.folder, "part"), path.join(this.folder, "in", name)];
    fs.mkdirSync(path.dirname(target), { recursive: true });
    fs.writeFileSync(beside, bytes);
    fs.renameSync(beside, target);
  }

  async ask(what) {
    const answer = await fetch(this.address + what);
    if (!answer.ok) throw new Error(`${what}: ${answer.status}`);
    return answer.json();
  }

  async frame(name) {
    return this.ask(`api/frames/${encodeURIComponent(name)}`);
  }

  /** Waits until this number of frames is in a state. */
  async untilCount(state, count, patienceMs) {
    await until(`${count} frames are ${state}`, async () => (await this.ask("api/status")).frames[state] >= count, patienceMs);
  }

  async stop() {
    const ended = new Promise((done) => this.child.once("exit", done));
    this.child.kill("SIGTERM");
    await ended;
  }
}

module.exports = { Watching, until };
