// Gaussians that the browser draws itself: the page's side of the worker.

/** Draws into a canvas by a worker; of what is asked for while it draws, the newest is drawn next. */
export class Splats {
  /**
   * @param canvas given to the worker for good
   * @param worker runs worker.js
   * @param on { frames(message), drawn(message), picked(message), track(message), trails(message), failed(message) }
   * @param mostBytes of files that are kept; Infinity where none can be fetched again, undefined for a bound
   */
  constructor(canvas, worker, on, mostBytes) {
    Object.assign(this, { worker, on, busy: null, next: null });
    const offscreen = canvas.transferControlToOffscreen();
    worker.onmessage = ({ data }) => this.receive(data);
    worker.onerror = (event) => on.failed({ during: "begin", words: event.message || "the worker does not run" });
    worker.postMessage({ kind: "canvas", canvas: offscreen, mostBytes }, [offscreen]);
  }

  /** Whether this browser can: WebGL2 in a worker. */
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

  /** Takes a compact file; its bytes are the worker's then. */
  add(bytes, name) {
    this.worker.postMessage({ kind: "file", bytes, name }, [bytes.buffer]);
  }

  /**
   * Draws, or does so after what is being drawn; of several such the last.
   *
   * @param request { place, camera, ahead }: place among the frames, camera as the service takes it, place to decode next; or
   *   { index, next, share, camera }: the index of a frame, of the next one or null, and the share 0…1 of the way between them
   * @param asked comes back with what was drawn
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
