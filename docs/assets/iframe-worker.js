// Lets the search run where browsers allow no workers, in pages read from the disk: a hidden frame takes the place of one.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super()
      this.waiting = []
      const frame = document.createElement("iframe")
      frame.hidden = true
      document.body.appendChild(frame)
      this.inside = frame.contentWindow
      this.inside.document.open()
      this.inside.document.write("<!doctype html><body></body>")
      this.inside.document.close()
      this.inside.postMessage = data => this.tell(this, data)
      this.inside.importScripts = (...urls) => urls.reduce((before, one) => before.then(() => this.load(one)), Promise.resolve())
      this.load(url).then(() => {
        this.waiting.forEach(data => this.tell(this.inside, data))
        this.waiting = null
      })
    }

    load(url) {
      return new Promise((resolve, reject) => {
        const script = this.inside.document.createElement("script")
        Object.assign(script, { src: url, onload: resolve, onerror: reject })
        this.inside.document.body.appendChild(script)
      })
    }

    tell(target, data) {
      const message = new MessageEvent("message", { data })
      target.dispatchEvent(message)
      if (target === this && this.onmessage) this.onmessage(message)
    }

    postMessage(data) {
      if (this.waiting) this.waiting.push(data)
      else this.tell(this.inside, data)
    }
  }
}
