// Browsers start no worker from a disk (file:). The theme's search then runs in a hidden frame instead.
if (location.protocol === "file:")
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      const frame = document.createElement("iframe");
      frame.hidden = true;
      document.body.append(frame);
      const inside = frame.contentWindow;
      inside.postMessage = (data) => {
        const event = new MessageEvent("message", { data });
        this.onmessage?.(event);
        this.dispatchEvent(event);
      };
      this.tell = (data) => inside.dispatchEvent(new inside.MessageEvent("message", { data }));
      const script = frame.contentDocument.createElement("script");
      script.src = url;
      this.ready = new Promise((done) => (script.onload = done));
      frame.contentDocument.head.append(script);
      this.frame = frame;
    }
    postMessage(data) {
      this.ready.then(() => this.tell(data));
    }
    terminate() {
      this.frame.remove();
    }
  };
