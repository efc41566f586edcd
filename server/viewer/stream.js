// Stream of a scene (docs/stream.md), whose subscriptions survive a broken connection.

import { address, scenePath, ServiceError, call, ticket } from "./service.js";

const PROTOCOL = "scas4d.stream.v1";
const GONE = 4404;
const WAITS_S = [0.3, 0.6, 1.2, 2.5, 5];

export class Stream {
  /**
   * @param scene id of the scene
   * @param on { state(name, seconds), scene(message), frame(message), bulk(head, bytes), error(message), gone(reason) }
   */
  constructor(scene, on) {
    this.scene = scene;
    this.on = on;
    this.subscriptions = new Map();
    this.tries = 0;
    this.closed = false;
    this.connect();
  }

  subscribe(id, topic, request = {}, tag = 0) {
    this.subscriptions.set(id, { type: "subscribe", id, topic, request, tag });
    this.send(this.subscriptions.get(id));
  }

  update(id, request, tag = 0) {
    const known = this.subscriptions.get(id);
    if (!known) return;
    Object.assign(known.request, request);
    known.tag = tag;
    this.send({ type: "update", id, request, tag });
  }

  unsubscribe(id) {
    if (this.subscriptions.delete(id)) this.send({ type: "unsubscribe", id });
  }

  close() {
    this.closed = true;
    clearTimeout(this.timer);
    this.socket?.close();
  }

  send(message) {
    if (this.socket?.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(message));
  }

  async connect() {
    try {
      const shown = await ticket();
      if (this.closed) return;
      const stream = address(`${scenePath(this.scene)}/stream`);
      stream.protocol = stream.protocol.replace("http", "ws");
      const socket = new WebSocket(stream, shown ? [PROTOCOL, shown] : [PROTOCOL]);
      socket.binaryType = "arraybuffer";
      this.socket = socket;
      socket.onopen = () => {
        this.tries = 0;
        this.on.state("live");
        for (const subscription of this.subscriptions.values()) this.send(subscription);
      };
      socket.onmessage = (event) => this.read(event.data);
      socket.onclose = (event) => (event.code === GONE ? this.end("The scene was deleted.") : this.broken());
    } catch (error) {
      if (error.status === 401 || error.status === 403) this.end(error.message, error.status);
      else this.broken();
    }
  }

  /** Requests the scene to find out why a handshake was refused, because the browser does not report the reason. */
  async broken() {
    if (this.closed) return;
    try {
      await call("GET", scenePath(this.scene));
    } catch (error) {
      if (this.closed) return;
      if (error instanceof ServiceError && [401, 403, 404].includes(error.status)) {
        this.end(error.status === 404 ? "The scene no longer exists." : error.message, error.status);
        return;
      }
    }
    const seconds = WAITS_S[Math.min(this.tries++, WAITS_S.length - 1)];
    this.on.state("lost", seconds);
    this.timer = setTimeout(() => this.connect(), 1000 * seconds * (0.75 + Math.random() / 2));
  }

  end(reason, status = 404) {
    if (this.closed) return;
    this.close();
    this.on.gone(reason, status);
  }

  read(data) {
    if (typeof data === "string") {
      const message = JSON.parse(data);
      if (message.type === "gone") this.end("The scene was deleted.");
      else this.on[message.type]?.(message);
      return;
    }
    const view = new DataView(data);
    const size = view.getUint32(4, true);
    const head = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 8, size)));
    this.on.bulk(head, new Uint8Array(data, 8 + size));
  }
}
