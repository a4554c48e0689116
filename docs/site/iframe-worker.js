// A page that is opened from a file may not start a Worker, which the search needs: a frame runs its script instead.
if (location.protocol === "file:") {
  const importScripts = "(...urls) => urls.reduce((before, url) => before.then(() => new Promise((done, failed) => {" +
    "const s = document.createElement('script'); s.src = url; s.onload = done; s.onerror = failed;" +
    "document.body.appendChild(s); })), Promise.resolve())";
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      const frame = Object.assign(document.createElement("iframe"), { hidden: true });
      document.body.appendChild(frame);
      this.inner = frame.contentWindow;
      this.inner.document.open();
      this.inner.document.write("<html><body><script>postMessage = data => parent.postMessage(data, '*');" +
        `importScripts = (${importScripts})</` + `script><script src="${url}"></` + "script></body></html>");
      this.inner.document.close();
      this.ready = new Promise(done => { frame.onload = done; });
      addEventListener("message", event => {
        if (event.source !== this.inner) return;
        const passed = new MessageEvent("message", { data: event.data });
        this.dispatchEvent(passed);
        if (this.onmessage) this.onmessage(passed);
      });
    }
    postMessage(data) {
      this.ready.then(() => this.inner.dispatchEvent(new MessageEvent("message", { data })));
    }
    terminate() { this.inner.frameElement.remove(); }
  };
}
