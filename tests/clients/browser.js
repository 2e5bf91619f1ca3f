// Headless Chromium, with a page whose console messages and requests are recorded.
//
// The CPU renders WebGL, so that pictures are the same with and without a graphics card.

const path = require("path");

const CHROMIUM = "/usr/bin/chromium";
const PATIENCE_MS = 300_000;
const OPTIONS = [
  // Checks run as root, in a separate container.
  "--no-sandbox",
  "--disable-dev-shm-usage",
  "--use-angle=swiftshader",
  "--enable-unsafe-swiftshader",
  "--hide-scrollbars",
  // Host names cannot be resolved: the page reaches only this machine.
  "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
];

/** Starts the browser; `modules` is where puppeteer-core is. */
async function startBrowser(modules) {
  const puppeteer = require(path.resolve(modules, "node_modules", "puppeteer-core"));
  const browser = await puppeteer.launch({ executablePath: CHROMIUM, headless: true, args: OPTIONS, protocolTimeout: PATIENCE_MS });
  return { browser, version: await browser.version(), close: () => browser.close() };
}

/** Opens an address, and collects errors and requests to other hosts in `faults`. */
async function openPage({ browser }, address, { width = 1440, height = 900 } = {}) {
  const page = await browser.newPage();
  const faults = [];
  const own = new URL(address).origin;
  page.on("console", (message) => {
    if (message.type() === "error") faults.push(`the console says: ${message.text()}`);
  });
  page.on("pageerror", (error) => faults.push(`an uncaught error: ${error}`));
  page.on("request", (request) => {
    const url = request.url();
    if (!/^(data|blob):/.test(url) && new URL(url).origin !== own) faults.push(`asks elsewhere: ${url}`);
  });
  // A long limit, because a busy machine is slow.
  page.setDefaultTimeout(PATIENCE_MS);
  await page.setViewport({ width, height });
  await page.goto(address);
  return { page, faults };
}

/** Measures pictures: the number of colours, and the difference of two pictures. */
class Darkroom {
  constructor(page) {
    this.page = page;
  }

  /** A new page, so that the page under test stays as it is. */
  static async make({ browser }) {
    return new Darkroom(await browser.newPage());
  }

  /** Of two pictures (PNG in base64): colours of the first, and the share of pixels that differ. */
  compare(first, second) {
    return this.page.evaluate(
      async (encoded) => {
        const [a, b] = await Promise.all(
          encoded.map(async (text) => {
            const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
            const picture = await createImageBitmap(new Blob([bytes]));
            const pen = new OffscreenCanvas(picture.width, picture.height).getContext("2d");
            pen.drawImage(picture, 0, 0);
            return pen.getImageData(0, 0, picture.width, picture.height).data;
          }),
        );
        const colours = new Set();
        let differing = 0;
        for (let i = 0; i < a.length; i += 4) {
          colours.add((a[i] << 16) | (a[i + 1] << 8) | a[i + 2]);
          differing += [0, 1, 2].some((k) => Math.abs(a[i + k] - b[i + k]) > 8);
        }
        return { colours: colours.size, differing: a.length === b.length ? differing / (a.length / 4) : 1 };
      },
      [first, second],
    );
  }
}

module.exports = { startBrowser, openPage, Darkroom };
