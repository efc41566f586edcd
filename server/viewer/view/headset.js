// Viewing in a headset with WebXR. The page paints, since only it may draw for a headset; the worker decodes and sorts.

import { cross, dot, scale, sub, unit } from "./geometry.js";
import { Painter } from "../splats/painter.js";
import { inside } from "../splats/rig.js";

const REACH = 1.5; // metres of the room that the orbit's distance fills
const NEAR = 0.05; // near plane in metres of the room
const [TURN, ZOOM] = [1.5, 1.2]; // radians and e-folds per second with the thumbstick fully deflected
const LONGEST_S = 0.1; // longest time between two pictures during which a thumbstick counts
const DEAD = 0.15; // deflection below which a thumbstick is at rest
const KEPT = 3; // states that the page keeps: those before and after the moment, and the previous one
const LOST_MS = 1000; // after which an unanswered request is repeated

export class Headset {
  /** Whether a headset is connected that this browser can draw for. */
  static async possible() {
    try {
      return (await navigator.xr?.isSessionSupported("immersive-vr")) === true;
    } catch {
      return false; // forbidden by the page that embeds this one
    }
  }

  /**
   * @param splats drawing in the worker, which has the frames
   * @param orbit orbit of the page, from which the scene is seen; the thumbstick moves it
   * @param on { moment(now), pressed(), ended() }: returns the moment to show, as in `Splats.draw`, or null; a trigger was pressed; the session has ended, or could not begin; called once
   */
  constructor(splats, orbit, on) {
    Object.assign(this, { splats, orbit, on, states: new Map(), paints: new Map() });
    Object.assign(this, { session: null, over: false, sorted: null, start: null, tick: null, askedAt: -Infinity });
  }

  /**
   * Begins a session; called while a click is handled.
   *
   * @throws Error if the browser refuses, or has no WebGL2; `ended` has been called then, too
   */
  async begin() {
    try {
      const session = await navigator.xr.requestSession("immersive-vr");
      if (this.over) return session.end(); // ended while the browser asked for permission
      this.session = session;
      this.splats.on.sorted = (message) => this.receive(message);
      session.addEventListener("select", () => this.on.pressed());
      session.addEventListener("end", () => {
        delete this.splats.on.sorted;
        this.painter?.gl.getExtension("WEBGL_lose_context")?.loseContext();
        this.finish();
      });
      this.painter = new Painter(document.createElement("canvas"), true);
      this.painter.gl.canvas.addEventListener("webglcontextrestored", () => this.cover());
      this.cover();
      this.space = await session.requestReferenceSpace("local");
      if (!this.over) session.requestAnimationFrame((...given) => this.frame(...given));
    } catch (error) {
      if (this.over) return; // nobody waits for it any more
      this.end();
      throw error;
    }
  }

  /** Lets the headset show what the painter's context draws. */
  cover() {
    if (this.over) return;
    this.layer = new XRWebGLLayer(this.session, this.painter.gl, { antialias: false, depth: false });
    this.session.updateRenderState({ baseLayer: this.layer });
  }

  end() {
    if (this.over) return;
    if (this.session) this.session.end().catch(() => {}); // may be ending already
    else this.finish();
  }

  finish() {
    this.over = true;
    this.on.ended();
  }

  /** Draws a picture for each eye. */
  frame(now, xr) {
    this.session.requestAnimationFrame((...given) => this.frame(...given));
    this.steer(this.tick === null ? 0 : Math.min((now - this.tick) / 1000, LONGEST_S));
    this.tick = now;
    const pose = xr.getViewerPose(this.space);
    if (!pose) return; // the headset does not know its pose at the moment
    this.start ??= startOf(pose.transform.matrix);
    const room = roomOf(this.orbit, this.start);
    const request = this.on.moment(now);
    if (request && now - this.askedAt > LOST_MS) this.ask(request, forward(pose.views[0], room), now);
    if (this.sorted) for (const view of pose.views) this.paint(this.layer.getViewport(view), view, room);
  }

  /** Lets the worker sort the Gaussians of a moment; until it answers, pictures show the previous one. */
  ask(request, axis, now) {
    this.askedAt = now;
    this.splats.worker.postMessage({ kind: "sort", ...request, axis, known: [...this.states.keys(), ...this.paints.keys()] });
  }

  receive(message) {
    this.askedAt = -Infinity;
    if (!message.order) return; // the frame is no longer loaded
    const [from, to] = [message.from, message.to].map((state) => state && (this.states.get(state.number) ?? state));
    const paint = this.paints.get(message.paint.number) ?? message.paint;
    const dropped = [from, to].some((state) => state && !state.texels) || (paint.number && !paint.values);
    if (dropped) return; // since the request; the next one asks for it again
    for (const state of [from, to]) if (state) keep(this.states, KEPT, state);
    if (paint.number) keep(this.paints, 1, paint);
    this.sorted = { ...message, from, to, paint: paint.values ?? paint };
  }

  paint({ x, y, width, height }, view, room) {
    const { painter, sorted } = this;
    const { world } = sorted;
    painter.screen = { frame: this.layer.framebuffer, x, y };
    painter.size(width, height);
    const near = Math.min(sorted.near, NEAR * room.size * world.metres_per_unit);
    painter.project(sorted, inside(cameraOf(view, room, width, height), { world }, near), sorted, sorted.paint);
    painter.colours(sorted.background);
  }

  /** Turns the scene with a thumbstick's horizontal axis, and brings it nearer with the vertical one. */
  steer(seconds) {
    for (const { gamepad } of this.session.inputSources) {
      const [x, y] = (gamepad?.axes ?? []).slice(-2).map((value) => (Math.abs(value) < DEAD ? 0 : value));
      if (x) this.orbit.turn(-TURN * x * seconds, 0);
      if (y) this.orbit.zoom(Math.exp(ZOOM * y * seconds));
    }
  }
}

/** Keeps a value under its number as the most recent one, and drops the oldest beyond `most`. */
function keep(values, most, value) {
  values.delete(value.number);
  values.set(value.number, value);
  if (values.size > most) values.delete(values.keys().next().value);
}

/** Head at the beginning: its place, and the axes of the room: right, up, and back from where it looks. Column-major pose. */
function startOf(pose) {
  const level = [pose[8], 0, pose[10]];
  const back = Math.hypot(...level) > 1e-3 ? unit(level) : [0, 0, 1]; // looking straight up or down
  return { head: pose.slice(12, 15), axes: [cross([0, 1, 0], back), [0, 1, 0], back] };
}

/** How the room lies in the scene: the head begins at the orbit's eye, upright, and looks at the orbit's target. */
function roomOf(orbit, { head, axes }) {
  const eye = orbit.eye();
  const { up } = orbit.rig;
  const out = sub(eye, orbit.target);
  const back = unit(sub(out, scale(up, dot(out, up))));
  const scene = [cross(up, back), up, back];
  const turn = [0, 1, 2].map((k) => [0, 1, 2].map((j) => dot(scene.map((axis) => axis[k]), axes.map((axis) => axis[j]))));
  return { eye, head, turn, size: orbit.distance / REACH }; // size: units of the scene in a metre of the room
}

/** Rows of the rotation from the scene to an eye of the headset, in OpenCV axes. */
function rowsOf(matrix, { turn }) {
  return [0, 1, 2].map((i) => turn.map((row) => SIGNS[i] * dot(row, [matrix[i], matrix[4 + i], matrix[8 + i]])));
}

const SIGNS = [1, -1, -1]; // from OpenGL axes (y up, z back) to OpenCV axes (y down, z forward)

const forward = (view, room) => rowsOf(view.transform.inverse.matrix, room)[2];

/** Camera of an eye in the service's format. */
function cameraOf(view, room, width, height) {
  const { matrix } = view.transform.inverse;
  const rows = rowsOf(matrix, room);
  const t = rows.map((row, i) => {
    const begin = dot([matrix[i], matrix[4 + i], matrix[8 + i]], room.head) + matrix[12 + i];
    return SIGNS[i] * room.size * begin - dot(row, room.eye);
  });
  const p = view.projectionMatrix;
  const intrinsics = [[p[0] * width / 2, 0, (1 - p[8]) * width / 2], [0, p[5] * height / 2, (1 + p[9]) * height / 2], [0, 0, 1]];
  return { intrinsics, world_to_camera: rows.map((row, i) => [...row, t[i]]), width, height };
}
