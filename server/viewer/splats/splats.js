// Drawing of Gaussians in the browser: the page's side of the worker.

/** Draws into a canvas with a worker; of the requests that arrive while it is drawing, only the newest is drawn next. */
export class Splats {
  /**
   * @param canvas canvas that is permanently transferred to the worker
   * @param worker worker that runs worker.js
   * @param on { frames(message), drawn(message), picked(message), track(message), trails(message), failed(message) }; a headset adds sorted(message)
   * @param mostBytes maximum bytes of files to keep; Infinity if files cannot be fetched again, undefined for the default
   */
  constructor(canvas, worker, on, mostBytes) {
    Object.assign(this, { worker, on, busy: null, next: null });
    const offscreen = canvas.transferControlToOffscreen();
    worker.onmessage = ({ data }) => this.receive(data);
    worker.onerror = (event) => on.failed({ during: "begin", words: event.message || "the worker cannot run" });
    worker.postMessage({ kind: "canvas", canvas: offscreen, mostBytes }, [offscreen]);
  }

  /** Whether this browser supports WebGL2 in a worker. */
  static possible() {
    try {
      const gl = typeof OffscreenCanvas === "undefined" ? null : new OffscreenCanvas(1, 1).getContext("webgl2");
      gl?.getExtension("WEBGL_lose_context")?.loseContext();
      return gl !== null && "transferControlToOffscreen" in HTMLCanvasElement.prototype;
    } catch {
      return false;
    }
  }

  receive(message) {
    if (message.kind === "drawn" || (message.kind === "failed" && message.during === "draw")) {
      message.asked = this.busy;
      this.busy = null;
      const next = this.next;
      this.next = null;
      if (next) this.draw(...next);
    }
    this.on[message.kind]?.(message);
  }

  /** Adds a compact file, whose bytes are transferred to the worker. */
  add(bytes, name) {
    this.worker.postMessage({ kind: "file", bytes, name }, [bytes.buffer]);
  }

  /** Adds live states, whose buffer is transferred to the worker; `starts` means that they do not continue the previous ones. */
  addLive(bytes, starts, name) {
    this.worker.postMessage({ kind: "live", bytes, starts, name }, [bytes.buffer]);
  }

  /**
   * Draws a picture, now or after the current one; of several pending requests, only the last is drawn.
   *
   * @param request { place, camera, ahead }: place among the frames, camera in the service's format, and place to decode next; or
   *   { index, next, share, camera }: index of a frame, index of the next one or null, and the share [0, 1] of the way between them
   * @param asked returned with the picture
   */
  draw(request, asked = {}) {
    if (this.busy) {
      this.next = [request, asked];
      return;
    }
    this.busy = asked;
    this.worker.postMessage({ kind: "draw", ...request });
  }

  look(changes) {
    this.worker.postMessage({ kind: "look", ...changes });
  }

  pick(u, v) {
    this.worker.postMessage({ kind: "pick", u, v });
  }

  follow(row) {
    this.worker.postMessage({ kind: "follow", row });
  }

  clear() {
    this.next = null;
    this.worker.postMessage({ kind: "clear" });
  }

  close() {
    this.worker.terminate();
  }
}
