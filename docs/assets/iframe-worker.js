// Browsers refuse workers under file://. There the search's worker runs in a hidden frame instead,
// which has what a worker's script asks of its global object: importScripts, postMessage, messages.
"use strict";
if (location.protocol === "file:") {
  const shim = `
    window.postMessage = (data) => parent.postMessage({ frame: name, data }, "*");
    window.importScripts = async (...urls) => {
      for (const url of urls)
        await new Promise((loaded, failed) => {
          const script = document.createElement("script");
          Object.assign(script, { src: url, onload: loaded, onerror: failed });
          document.head.append(script);
        });
    };
    addEventListener("told", (event) =>
      dispatchEvent(new MessageEvent("message", { data: event.detail })));`;
  let workers = 0;
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      const name = `worker-${workers++}`;
      this.frame = Object.assign(document.createElement("iframe"), { name, hidden: true });
      document.body.append(this.frame);
      const inside = this.frame.contentDocument;
      inside.write("<!doctype html><head></head>");
      inside.close();
      this.ready = new Promise((loaded) => {
        inside.head.append(Object.assign(inside.createElement("script"), { text: shim }));
        const work = inside.createElement("script");
        Object.assign(work, { src: url, onload: loaded });
        inside.head.append(work);
      });
      addEventListener("message", ({ data }) => {
        if (data?.frame !== name) return;
        const event = new MessageEvent("message", { data: data.data });
        this.dispatchEvent(event);
        this.onmessage?.(event);
      });
    }
    async postMessage(data) {
      await this.ready;
      const view = this.frame.contentWindow;
      view.dispatchEvent(new view.CustomEvent("told", { detail: data }));
    }
    terminate() {
      this.frame.remove();
    }
  };
}
