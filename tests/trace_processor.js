// Perfetto's trace processor between standard input and output, in its own protocol.
// It is the WebAssembly of Perfetto's user interface in the folder named; this plays the browser.
const fs = require("fs"), path = require("path");
const folder = process.argv[2], stdin = process.stdin;
const read = (url) => new Uint8Array(fs.readFileSync(path.join(folder, path.basename(url))));
globalThis.self = globalThis;
globalThis.WorkerGlobalScope = function () {};
globalThis.location = { href: `file://${folder}/engine_bundle.js` };
globalThis.XMLHttpRequest = class {
  open(method, url) { this.url = url; }
  send() { this.response = read(this.url).buffer; }
};
globalThis.process = undefined; // or it would know that this is no browser
console.log = console.warn = console.error = () => {};
(0, eval)(Buffer.from(read("engine_bundle.js")).toString());
const port = { postMessage: (data) => fs.writeSync(1, Buffer.from(data)) };
self.onmessage({ data: port });
setImmediate(() => stdin.on("data", (data) => port.onmessage({ data: new Uint8Array(data) })));
