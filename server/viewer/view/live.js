// Live view from a camera that the user moves, rendered by the service or drawn by the browser while the camera moves.

import { Orbit, project, readCamera } from "./geometry.js";
import { paintDepth } from "./colours.js";
import { listenToPointer, moveByKey } from "./gestures.js";
import { Headset } from "./headset.js";
import { Here } from "./here.js";
import { between, drawFrusta, drawTracks } from "./overlay.js";
import { readable } from "../page.js";
import { fetched, scenePath } from "../service.js";

const SETTLE_MS = 220;
const TOUCHED_MS = 15_000; // how long after a user action new frames are loaded, so that they can be drawn here
const SLOW_MS = 1000;
const TARGET_MS = 90;
const EMPTY = [16, 19, 24];
const FIT_PX = 200;
const COVERED = 40; // minimum alpha, of 255, of a pixel that shows something
const MODES = {
  colour: { kinds: ["colour"], format: "jpeg" },
  depth: { kinds: ["depth"], format: "float32" },
  parts: { kinds: ["parts"], format: "png" },
  alpha: { kinds: ["alpha"], format: "png" },
};

export class LiveView {
  /** @param on { pick(u, v, camera, frame), shown(info), live(times), turned(), slow(mode), stale(whether), parts(count) } */
  constructor(canvas, overlay, on) {
    this.canvas = canvas;
    this.overlay = overlay;
    this.on = on;
    this.mode = "colour";
    this.parts = null;
    this.frame = null;
    this.background = null; // null selects the scene's own
    this.showFrusta = false;
    this.tracks = [];
    this.largest = 8e6;
    this.here = new Here(canvas, { drawn: (...drawn) => this.drawnHere(...drawn), arrived: (all) => this.arrived(all), parts: (count) => on.parts(count) });
    this.touchedAt = this.movedAt = -Infinity;
    this.headset = null; // shows the scene in place of the page
    this.listen();
    document.addEventListener("visibilitychange", () => this.moved());
    new ResizeObserver(() => this.moved()).observe(canvas.parentElement);
  }

  /** Opens a scene, given its stream and rig. */
  open(stream, rig) {
    this.stream = stream;
    this.scene = stream.scene;
    this.rig = rig.cameras.map(readCamera);
    this.orbit = new Orbit(this.rig);
    this.tag = 0;
    this.asked = new Map();
    this.shown = null;
    this.newest = null; // index of the last committed frame that was announced
    this.takesFrames = false; // whether frames were committed since the scene was opened
    this.coarse = 1;
    this.frame = null;
    this.between = { next: null, share: 0 };
    this.overtaken = this.exact = 0;
    this.clear();
    this.here.open(this.scene);
    if (!this.drawHere()) this.request();
  }

  close() {
    this.headset?.end();
    this.stream = null;
    this.here.close();
    clearTimeout(this.settle);
    clearTimeout(this.slow);
    this.clear();
  }

  clear() {
    this.shown = null;
    this.picture = null;
    for (const canvas of [this.canvas, this.overlay]) canvas.getContext("2d").clearRect(0, 0, canvas.width, canvas.height);
  }

  /** Sets the kind of picture; until the new picture arrives, the current one is marked as stale. */
  setMode(mode) {
    this.mode = mode;
    if (this.shown) this.on.stale(this.shown.mode !== mode);
    this.moved(true);
  }

  /** @param background [red, green, blue] in [0, 1], or null for the scene's own */
  setBackground(background) {
    this.background = background;
    this.moved(true);
  }

  setParts(count) {
    this.parts = count;
    if (this.mode === "parts") this.moved(true);
  }

  /** @param touched whether the user chose the frame */
  setFrame(frame, touched = false) {
    this.frame = frame;
    this.between = { next: null, share: 0 };
    if (touched) this.touchedAt = performance.now();
    this.moved(true);
  }

  /** Whether moments between a frame and the next one can be drawn. */
  smooth(frame, next) {
    return this.here.draws(this.mode) && this.here.has(frame) && this.here.has(next);
  }

  /** Sets a moment between the chosen frame and the next one. */
  setBetween(next, share) {
    this.between = { next, share };
    this.touchedAt = performance.now();
    this.moved();
  }

  /** Sets the renderer: "auto", "here" or "service". */
  setDrawn(how) {
    this.here.choose(how);
    this.touch();
  }

  /** Sets trails and hidden parts, which only the browser draws. */
  setExtras(extras) {
    this.here.show(extras);
    this.touch();
  }

  /** Requests the parts, so that they can be listed. */
  askParts() {
    this.here.askParts(this.frame ?? readable().at(-1)?.index);
    this.touch();
  }

  /** Handles a committed frame; from the second one on, the page follows the live take. */
  committed(index) {
    this.takesFrames ||= this.newest !== null && index > this.newest;
    this.newest = index;
    this.follow();
  }

  /** Subscribes to the live states while the page draws the newest frame itself, and unsubscribes otherwise. */
  follow() {
    if (!this.stream) return false;
    const { subscriptions } = this.stream;
    const wanted = this.frame === null && this.here.draws(this.mode) && (this.takesFrames || this.isTouched()) && !document.hidden;
    if (wanted && !subscriptions.has("states")) this.stream.subscribe("states", "states");
    else if (!wanted && subscriptions.has("states")) {
      this.stream.unsubscribe("states");
      this.here.live.frame = null;
    }
    return wanted;
  }

  /** Draws a new live state. */
  receiveState(head, bytes) {
    if (this.follow()) this.here.receive(head, bytes);
    this.moved();
  }

  /**
   * Shows the scene in a headset until it is called again or the person leaves.
   *
   * @param pressed called when a trigger of the headset is pressed
   * @throws Error if the headset cannot be used
   */
  async wear(pressed) {
    if (this.headset) return this.headset.end();
    if (!this.stream) return;
    const ended = () => {
      this.headset = null;
      this.moved();
    };
    this.headset = new Headset(this.here.begin(), this.orbit, { moment: () => this.momentHere(), pressed, ended });
    await this.headset.begin();
    this.moved();
  }

  /** Passes mode, background and parts on to the headset, so that the service need not render. */
  drawInHeadset() {
    clearTimeout(this.settle);
    this.stream.unsubscribe("view");
    this.here.setLook(this.mode, this.background);
    if (this.mode === "parts") this.here.askParts(this.frame ?? readable().at(-1)?.index);
  }

  /** Moment to draw here, { index, next, share }; null if its frame is not loaded. */
  momentHere() {
    const live = this.follow();
    const index = live ? this.here.live.frame : this.frame ?? readable().at(-1)?.index;
    if (index === undefined) return null;
    if (!live && !this.here.hasFailed()) this.here.fetch(index);
    if (!this.here.has(index)) return null;
    return live ? this.here.liveMoment() : { index, ...this.between };
  }

  /** Looks through a camera of the rig. */
  lookFrom(index) {
    this.orbit.from(this.rig[index]);
    this.touch();
  }

  /** Handles a user action on the view. */
  touch() {
    this.touchedAt = performance.now();
    this.moved();
  }

  isTouched() {
    return this.here.alone || performance.now() - this.touchedAt < TOUCHED_MS;
  }

  // Requesting pictures.

  size(share) {
    const box = this.canvas.parentElement.getBoundingClientRect();
    const dense = Math.min(window.devicePixelRatio || 1, 1.5) * share;
    let [width, height] = [Math.max(16, box.width * dense), Math.max(16, box.height * dense)];
    const over = Math.sqrt(width * height / Math.min(this.largest, 1.4e6));
    if (over > 1) [width, height] = [width / over, height / over];
    return [Math.round(width), Math.round(height)];
  }

  /** Draws or requests a picture after a change of camera, size or mode: a quick one now, a sharp one at rest. */
  moved(sharp = false) {
    if (!this.stream) return;
    if (this.headset?.session) return this.drawInHeadset();
    if (document.hidden) return void this.follow();
    clearTimeout(this.settle);
    this.movedAt = performance.now();
    if (this.drawHere(true)) this.settle = setTimeout(() => this.rest(), SETTLE_MS);
    else {
      this.request(sharp ? 1 : this.coarse);
      if (!sharp && this.coarse < 1) this.settle = setTimeout(() => this.request(1), SETTLE_MS);
    }
    this.on.turned?.();
  }

  /** Shows the picture at rest: the service's exact one, or a sharp one drawn here. */
  rest() {
    if (!this.here.alone || !this.drawHere(false)) this.request(1);
  }

  /** Draws the view in the page; returns false if it cannot, so that the service must render it. */
  drawHere(moving = false) {
    const { here } = this;
    const live = this.follow();
    if (!here.draws(this.mode) || !(live || (this.isTouched() && readable().length))) return false;
    const moment = this.momentHere();
    if (!moment) return here.alone && !here.said;
    if (here.alone || live) this.stream.unsubscribe("view"); // otherwise, the service would render every new frame
    this.overtaken = this.tag; // pictures that have not arrived yet show another view
    clearTimeout(this.slow);
    const camera = this.orbit.camera(...here.size(this.canvas.parentElement.getBoundingClientRect(), moving));
    here.draw({ ...moment, camera, mode: this.mode, background: this.background, moving });
    return true;
  }

  drawnHere(asked, { range, place }) {
    if (!this.stream || asked.serial <= this.exact || asked.mode !== this.mode) return;
    this.here.reveal();
    this.shown = { camera: asked.camera, frame: asked.index, next: asked.next, share: place % 1, mode: asked.mode, tag: this.shown?.tag ?? 0 };
    this.on.stale(false);
    this.draw();
    const [near, far] = range ?? [];
    this.on.shown({ ...this.shown, width: asked.camera.width, height: asked.camera.height, near, far, here: true });
    const delay = this.here.liveDelay(asked);
    if (delay !== null) this.on.live({ frame: this.here.live.frame, published: this.here.live.age, drawn: delay / 1000 });
    if (this.frame === null && asked.next !== null) requestAnimationFrame(() => this.frame === null && this.moved());
  }

  /** Handles the arrival of frames that can be drawn here. */
  arrived(all = false) {
    if (this.stream && (all || this.here.alone || performance.now() - this.movedAt < SETTLE_MS)) this.moved();
  }

  request(share = 1) {
    const [width, height] = this.size(share);
    const camera = this.orbit.camera(width, height);
    const frame = this.follow() ? this.here.live.frame : this.frame;
    const request = { camera, frame, parts: this.mode === "parts" ? this.parts : null,
      background: this.background, ...MODES[this.mode] };
    this.asked.set(++this.tag, { camera, mode: this.mode, at: performance.now(), share });
    this.canvas.parentElement.dataset.asked = this.tag;
    clearTimeout(this.slow);
    this.slow = setTimeout(() => this.stream && this.on.slow(this.mode), SLOW_MS);
    if (this.asked.size > 64) this.asked.delete(this.asked.keys().next().value);
    if (this.stream.subscriptions.has("view")) this.stream.update("view", request, this.tag);
    else this.stream.subscribe("view", "render", request, this.tag);
  }

  // Showing pictures.

  async receive(head, bytes) {
    const asked = this.asked.get(head.tag);
    if (!asked || asked.mode !== this.mode || head.tag <= this.overtaken) return;
    const first = !asked.answered;
    asked.answered = true;
    const number = this.latest = (this.latest || 0) + 1;
    const { stream } = this;
    const painted = await this.decode(asked, head, bytes);
    // Decoding is asynchronous: in the meantime, a newer picture may have been painted or another scene opened.
    if (number < (this.painted || 0) || this.stream !== stream || asked.mode !== this.mode || head.tag <= this.overtaken) return;
    this.painted = number;
    this.exact = this.here.serial;
    this.here.hide();
    const { width, height } = asked.camera;
    this.canvas.width = width;
    this.canvas.height = height;
    const context = this.canvas.getContext("2d");
    if (painted.image) context.putImageData(painted.image, 0, 0);
    else context.drawImage(painted.bitmap, 0, 0);
    const milliseconds = first ? performance.now() - asked.at : null;
    if (first && head.missed === 0) {
      this.adapt(milliseconds, asked.share);
      this.here.measure("service", milliseconds);
    }
    if (head.tag === this.tag) clearTimeout(this.slow);
    this.shown = { camera: asked.camera, frame: head.frame, mode: asked.mode, tag: head.tag };
    this.on.stale(false);
    this.draw();
    this.on.shown({ ...this.shown, milliseconds, width, height, near: painted.near, far: painted.far });
  }

  async decode(asked, head, bytes) {
    if (asked.mode === "depth") {
      const { width, height } = asked.camera;
      return paintDepth(new Float32Array(bytes.slice().buffer), width, height, EMPTY);
    }
    return { bitmap: await createImageBitmap(new Blob([bytes], { type: head.media_type })) };
  }

  /** Adapts the size of pictures while the camera moves to the time that they take. */
  adapt(milliseconds, share) {
    const wanted = share * Math.sqrt(TARGET_MS / Math.max(milliseconds, 1));
    this.coarse = Math.max(0.3, Math.min(1, 0.6 * this.coarse + 0.4 * wanted));
  }

  /** Draws the tracks and the rig over the current picture, with its camera. */
  draw() {
    const box = this.canvas.parentElement.getBoundingClientRect();
    const dense = window.devicePixelRatio || 1;
    const [width, height] = [Math.round(box.width * dense), Math.round(box.height * dense)];
    if (this.overlay.width !== width || this.overlay.height !== height) Object.assign(this.overlay, { width, height });
    const context = this.overlay.getContext("2d");
    context.clearRect(0, 0, width, height);
    if (!this.shown) return;
    const camera = readCamera(this.shown.camera);
    const [sx, sy] = [width / camera.width, height / camera.height];
    const place = (point) => {
      const seen = project(camera, point);
      return seen && [seen[0] * sx, seen[1] * sy];
    };
    if (this.showFrusta) drawFrusta(context, place, this.rig, this.orbit.rig.radius, dense);
    const { frame, next, share } = this.shown;
    if (share > 0) drawTracks(context, place, between(this.tracks, frame, next, share), frame + share * (next - frame), dense);
    else drawTracks(context, place, this.tracks, frame, dense);
  }

  // Pointer and keys.

  listen() {
    listenToPointer(this.overlay, () => (this.stream ? this.orbit : null), { moved: () => this.touch(), click: (event) => this.click(event) });
  }

  /** Handles a key that moves the camera or follows a point; returns whether it is one of these. */
  key(event) {
    if (!this.stream) return false;
    if (event.key.toLowerCase() === "t") {
      this.pickMiddle();
      return true;
    }
    if (!moveByKey(this.orbit, event, this.rig[0])) return false;
    this.touch();
    return true;
  }

  /** Centres the contents of the scene and changes the distance so that they fill the view. */
  async fit() {
    if (!this.shown) return;
    const { stream } = this;
    const box = this.canvas.parentElement.getBoundingClientRect();
    const small = FIT_PX / Math.max(box.width, box.height);
    const camera = this.orbit.camera(Math.round(box.width * small), Math.round(box.height * small));
    const bitmap = await createImageBitmap(await this.rendered({ camera, kinds: ["alpha"], format: "png" }));
    if (this.stream !== stream) return; // another scene was opened in the meantime
    const context = new OffscreenCanvas(bitmap.width, bitmap.height).getContext("2d", { willReadFrequently: true });
    context.drawImage(bitmap, 0, 0);
    const { data, width, height } = context.getImageData(0, 0, bitmap.width, bitmap.height);
    const seen = { left: width, top: height, right: -1, bottom: -1 };
    for (let y = 0; y < height; y++) for (let x = 0; x < width; x++) {
      if (data[4 * (y * width + x)] < COVERED) continue;
      Object.assign(seen, { left: Math.min(seen.left, x), right: Math.max(seen.right, x), top: Math.min(seen.top, y), bottom: y });
    }
    if (seen.right < 0) this.orbit.from(this.rig[0]);
    else this.orbit.fit(seen, camera);
    this.touch();
  }

  /** Returns a sharp picture of the current view as a file. */
  snapshot() {
    const { camera, mode } = this.shown;
    return this.rendered({ camera, kinds: MODES[mode].kinds, format: "png", background: this.background, parts: mode === "parts" ? this.parts : null });
  }

  async rendered(request) {
    return (await fetched("POST", `${scenePath(this.scene)}/render`, { frame: this.shown.frame, ...request })).blob();
  }

  pickMiddle() {
    if (this.shown) this.on.pick(this.shown.camera.width / 2, this.shown.camera.height / 2, this.shown.camera, this.shown.frame);
  }

  click(event) {
    if (!this.shown) return;
    const box = this.overlay.getBoundingClientRect();
    const { camera, frame } = this.shown;
    const u = (event.clientX - box.left) / box.width * camera.width;
    const v = (event.clientY - box.top) / box.height * camera.height;
    this.on.pick(u, v, camera, frame);
  }
}
