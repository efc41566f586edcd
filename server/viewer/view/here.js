// Views that the page draws itself from compact files and live states, so that turning, playing and scrubbing cost the service nothing.

import { fetched, scenePath } from "../service.js";
import { node, note, readable } from "../page.js";
import { Pace } from "../splats/pace.js";
import { Splats } from "../splats/splats.js";

const CHUNK = 24; // frames per request, for scrubbing and playing
const AHEAD = 8; // number of frames before the end of a chunk at which the next chunk is requested
const SLOW_MS = 250; // time per picture that counts as slow: fewer than four per second
const SLOWER = 1.5; // factor over the service's time from which the browser counts as slower
const WARM = 3; // pictures before times are measured, since the first ones compile shaders
const LONGEST_BLEND_MS = 200; // longest transition between two live states
const AGAIN_MS = 20_000; // delay before another attempt after a failure
const SPAN = 30; // number of frames in a trail
const BESIDE = ["ahead", "trails", "track", "sort"]; // operations whose failure does not affect the picture
const KINDS = ["colour", "depth", "alpha"]; // parts come from the service, which finds the Gaussian with the largest weight in each pixel

export class Here {
  /** @param picture canvas below this one  @param on { drawn(asked, message), arrived(), parts(count) } */
  constructor(picture, on) {
    Object.assign(this, { picture, on, how: "auto", extras: { trails: 0, hiddenParts: [] }, withParts: false, pace: new Pace(), splats: null, scene: null, serial: 0, opened: 0 });
    this.possible = Splats.possible();
    this.times = { here: 0, service: 0 }; // milliseconds per picture, smoothed
    this.forget();
  }

  forget() {
    this.frames = new Set(); // indices of the frames that the worker has
    this.asked = new Map(); // pictures that are being drawn, keyed by tag
    this.wish = null;
    this.live = { frame: null, previous: null, at: -Infinity, gap: 0, age: null, drawn: true };
    this.failedAt = -Infinity;
    this.drawn = 0;
    this.slow = false;
    this.said = "";
    this.labelled = 0; // number of known parts
  }

  open(scene) {
    this.scene = scene;
  }

  close() {
    this.scene = null;
    this.opened++; // pending answers belong to another scene
    this.abort?.abort();
    this.abort = null;
    this.splats?.clear();
    this.forget();
    this.hide();
    this.withParts = false;
    this.show({ hiddenParts: [] });
    this.on.parts(0);
  }

  /** Chooses the renderer: "auto" by measured speed, "here" or "service". */
  choose(how) {
    this.how = how;
    this.slow = false;
    this.failedAt = -Infinity;
  }

  /** Shows trails or hides parts, which the service cannot; in the meantime, pictures at rest are drawn here, too. */
  show(extras) {
    Object.assign(this.extras, extras);
    this.splats?.look({ ...this.extras, span: SPAN });
  }

  /** Whether pictures at rest are drawn here, too. */
  get alone() {
    return this.how === "here" || this.extras.trails > 0 || this.extras.hiddenParts.length > 0;
  }

  /** Requests the parts of all Gaussians, once, together with the frames around the given one. */
  askParts(index) {
    const begin = this.beginOf(index);
    if (this.withParts || begin === undefined) return;
    this.withParts = true;
    this.get(begin, true);
  }

  /** Whether pictures of a mode are drawn here once their frame is loaded. */
  draws(mode) {
    return this.possible && this.how !== "service" && KINDS.includes(mode) && !(this.how === "auto" && this.slow)
      && !this.hasFailed();
  }

  /** Whether loading or drawing has failed recently. */
  hasFailed() {
    return performance.now() - this.failedAt < AGAIN_MS;
  }

  has(index) {
    return this.frames.has(index);
  }

  /** Takes a message of the topic `states`: the newest state, `head.age` seconds after its commit. */
  receive(head, bytes) {
    const { live } = this;
    const starts = head.after === undefined;
    if (!starts && head.after !== live.frame) return; // sent before the page unsubscribed; the new subscription starts anew
    const now = performance.now();
    const gap = now - live.at;
    this.begin().addLive(bytes, starts, this.opened);
    Object.assign(live, { previous: starts ? null : live.frame, frame: head.frame, at: now, age: head.age ?? null, drawn: false,
      gap: starts ? 0 : live.gap ? 0.7 * live.gap + 0.3 * gap : gap });
    this.frames.add(head.frame); // the worker handles messages in order
  }

  /**
   * Moment of the live take that a picture begun now should show, { index, next, share }: the motion from the previous state
   * to the newest takes as long as the time between states, so that it is smooth, but at most LONGEST_BLEND_MS.
   */
  liveMoment() {
    const { frame, previous, at, gap } = this.live;
    const shown = performance.now() + this.times.here; // when the picture will be finished
    const share = (shown - at) / Math.min(gap, LONGEST_BLEND_MS);
    return previous !== null && share < 1 ? { index: previous, next: frame, share } : { index: frame, next: null, share: 0 };
  }

  /** Milliseconds from the arrival of the newest live state to its first picture, once; null for later pictures. */
  liveDelay({ index, next }) {
    const { live } = this;
    if (live.drawn || (next ?? index) !== live.frame) return null;
    live.drawn = true;
    return performance.now() - live.at;
  }

  /** Requests a frame from the service, together with the frames around it. */
  fetch(index) {
    const frames = readable();
    const at = frames.findIndex((report) => report.index === index);
    if (!this.has(index)) this.get(this.beginOf(index));
    else if (at % CHUNK >= CHUNK - AHEAD) {
      const next = frames[at - (at % CHUNK) + CHUNK]?.index;
      if (next !== undefined && !this.has(next)) this.get(next);
    }
  }

  /** First frame of the chunk that contains a frame; undefined if the frame is not readable. */
  beginOf(index) {
    const frames = readable();
    const at = frames.findIndex((report) => report.index === index);
    return frames[at - (at % CHUNK)]?.index;
  }

  /** Requests a chunk of frames, one request at a time; only one further request is kept in the meantime. */
  async get(first, parts = false) {
    if (first === undefined) return;
    const wanted = JSON.stringify([first, parts]);
    if (this.abort) {
      if (this.abort.wanted !== wanted && !this.wish?.[1]) this.wish = [first, parts];
      return;
    }
    const { scene } = this;
    const abort = (this.abort = new AbortController());
    abort.wanted = wanted;
    try {
      const frames = readable().filter((report) => report.index >= first).slice(0, CHUNK).map((report) => report.index);
      for (let from = first, left = CHUNK; left > 0;) { // a response ends at the end of one of the service's files
        const answer = await fetched("GET", `${scenePath(scene)}/states.s4d?first=${from}&limit=${left}&parts=${parts}`, undefined, abort.signal);
        const bytes = new Uint8Array(await answer.arrayBuffer());
        if (this.abort !== abort) return;
        this.begin().add(bytes, this.opened);
        const following = Number(answer.headers.get("X-Next-Frame") ?? Infinity);
        left = following > from ? frames.filter((index) => index >= following).length : 0;
        from = following;
      }
    } catch (error) {
      if (this.abort !== abort) return;
      this.failed({ words: error.message });
    }
    this.abort = null;
    const next = this.wish;
    this.wish = null;
    if (next) this.get(...next);
  }

  begin() {
    if (this.splats) return this.splats;
    this.canvas = node("canvas", { id: "drawn", width: 16, height: 16, "aria-hidden": "true", hidden: true });
    this.picture.after(this.canvas);
    const worker = new Worker(new URL("../splats/worker.js", import.meta.url), { type: "module" });
    const hear = (action) => (message) => (message.name ?? message.asked?.opened ?? this.opened) === this.opened && action(message);
    this.splats = new Splats(this.canvas, worker, {
      frames: hear(({ frames, parts, live }) => {
        this.frames = new Set(frames.map(([index]) => index));
        if (this.live.frame !== null) this.frames.add(this.live.frame); // the worker may not have handled its message yet
        this.said = "";
        if (parts !== this.labelled) this.on.parts((this.labelled = parts));
        if (!live) this.on.arrived(); // live states are drawn without waiting for this message
      }),
      drawn: hear((message) => this.shown(message)),
      failed: hear((message) => this.failed(message)),
      trails: () => this.on.arrived(true),
    });
    this.show({});
    return this.splats;
  }

  failed({ during, gone, words }) {
    if (gone || BESIDE.includes(during)) return gone && this.on.arrived(); // the frame is requested again, or the failure is not visible
    if (!this.labelled) this.withParts = false; // may be requested again
    this.failedAt = performance.now();
    this.said = words;
    if (this.how === "here") note(`The view cannot be drawn here: ${words}`);
    this.hide();
    this.on.arrived();
  }

  size(box, moving) {
    return this.pace.size(box, moving);
  }

  /**
   * Draws a moment and calls `on.drawn` when it is finished.
   *
   * @param asked { index, next, share, camera, mode, background, moving }: share [0, 1] of the way from one frame to the next
   */
  draw(asked) {
    this.setLook(asked.mode, asked.background);
    const share = this.pace.share;
    const request = { ...asked, serial: ++this.serial, opened: this.opened, pace: share };
    const { index, next, share: way, camera } = asked;
    this.splats.draw({ index, next, share: way, camera }, request);
  }

  setLook(mode, background) {
    const look = JSON.stringify([mode, background]);
    if (look === this.look) return;
    this.look = look;
    this.splats.look({ mode, background });
  }

  shown(message) {
    const { asked } = message;
    this.drawn++;
    if (asked.moving && this.drawn > WARM) {
      this.pace.took(message.milliseconds, asked.pace);
      this.measure("here", message.milliseconds - message.decoding);
      this.slow = this.times.here > SLOW_MS && this.times.here > SLOWER * this.times.service && this.times.service > 0;
    }
    this.on.drawn(asked, message);
  }

  /** Records the milliseconds that a picture took, here or at the service. */
  measure(who, milliseconds) {
    this.times[who] = this.times[who] ? 0.8 * this.times[who] + 0.2 * milliseconds : milliseconds;
  }

  reveal() {
    this.canvas.hidden = false;
  }

  hide() {
    if (this.canvas) this.canvas.hidden = true;
  }
}
