// Site search from disk: browsers start no Worker for file:// pages, so that an iframe runs its script instead.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      const frame = document.createElement("iframe");
      frame.hidden = true;
      document.body.appendChild(frame);
      this.inner = frame.contentWindow;
      window.addEventListener("message", (event) => {
        if (event.source !== this.inner) return;
        const message = new MessageEvent("message", { data: event.data });
        this.dispatchEvent(message);
        if (this.onmessage) this.onmessage(message);
      });
      const load = `(source) => new Promise((done, failed) => {
        const script = document.createElement("script");
        Object.assign(script, { src: source, onload: done, onerror: failed });
        document.body.appendChild(script);
      })`;
      this.ready = new Promise((done) => (this.inner.started = done));
      this.inner.document.open();
      this.inner.document.write(`<body><script>
        const load = ${load};
        window.postMessage = (data) => parent.postMessage(data, "*");
        window.importScripts = (...sources) =>
          sources.reduce((before, source) => before.then(() => load(source)), Promise.resolve());
        load(${JSON.stringify(String(url))}).then(() => window.started());
      <\/script></body>`);
      this.inner.document.close();
    }

    postMessage(data) {
      this.ready.then(() => this.inner.dispatchEvent(new MessageEvent("message", { data })));
    }

    terminate() {}
  };
}
