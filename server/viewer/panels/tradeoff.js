// Trade-off panel: error over milliseconds per frame, and the budget.

import { element, step } from "./charts.js";
import { call, scenePath } from "../service.js";

// Points with a time but no error are in a separate strip below the plot, so that the two are not confused.
const [LEFT, RIGHT, TOP, STRIP, BOTTOM] = [56, 20, 36, 34, 18];
const EFFECT_FRAMES = 16;
// Under a time budget, every frame has a different number of iterations. Measured points with about the same time and
// similar iterations are therefore merged.
const [ALIKE_TIME, ALIKE_ITERATIONS] = [1.06, 1.5];
const EVERY_MS = 3000;
const REPLAY_EVERY_MS = 700;
const REPLAYED = [25, 50, 200];
const STEPS = 1000;
// Ends of the logarithmic slider.
const RANGES = { iterations: [5, 1000], budget_ms: [20, 20000], keep_up_fps: [0.1, 60] };
const UNITS = { iterations: "iterations", budget_ms: "ms", keep_up_fps: "frames/s" };
const HOW = { measured: "measured on frames of the scene", replayed: "replayed", extrapolated: "extrapolated, time only" };

/** Formats a time in milliseconds as ms or s. */
const spoken = (time) => (time < 1000 ? `${short(time)} ms` : `${short(time / 1000)} s`);

const median = (values) => [...values].sort((a, b) => a - b)[values.length >> 1];

/** Rounds to three significant digits, or two below 100, which is enough for a choice. */
const short = (value) => Number(value.toPrecision(value < 100 ? 2 : 3));

/** Merges the measured points that took about the same time into their mean, weighted by frames. */
function grouped(points) {
  const groups = [];
  for (const point of points.filter((one) => one.kind === "measured").sort((a, b) => a.milliseconds - b.milliseconds)) {
    const alike = (name, factor) => (one) => Math.abs(Math.log(one[name] / point[name])) < Math.log(factor);
    const fits = (group) => group.every(alike("milliseconds", ALIKE_TIME)) && group.every(alike("iterations", ALIKE_ITERATIONS));
    const group = groups.find(fits);
    if (group) group.push(point);
    else groups.push([point]);
  }
  const measured = groups.map((group) => {
    if (group.length === 1) return group[0];
    const mean = (name) => {
      const known = group.filter((one) => one[name] !== null);
      const frames = known.reduce((sum, one) => sum + one.frames, 0);
      return frames ? known.reduce((sum, one) => sum + one.frames * one[name], 0) / frames : null;
    };
    const counts = group.map((one) => one.iterations);
    return {
      ...group[0], iterations: Math.round(mean("iterations")), milliseconds: mean("milliseconds"), error: mean("error"), psnr: mean("psnr"),
      frames: group.reduce((sum, one) => sum + one.frames, 0), from: Math.min(...counts), to: Math.max(...counts),
    };
  });
  return [...measured, ...points.filter((one) => one.kind !== "measured")];
}

export class Tradeoff {
  /** @param $ returns the element with an id */
  constructor($) {
    Object.assign(this, { $, opened: 0, scene: null, model: null, asked: null, effective: null, timer: null, due: 0, moving: false, putting: false, updates: [] });
    $("budget-kind").addEventListener("change", () => this.place(true));
    $("budget").addEventListener("input", () => {
      this.moving = true;
      this.describe();
      this.draw();
    });
    $("budget").addEventListener("change", () => this.put());
    // If the slider is released where it was, there is no change event.
    $("budget").addEventListener("pointerup", () => setTimeout(() => this.putting || this.rest(), 50));
    $("measure").addEventListener("click", () => this.measure());
    new ResizeObserver(() => this.draw()).observe($("tradeoff"));
  }

  open(scene) {
    this.close();
    this.scene = scene;
    this.refresh();
  }

  close() {
    clearTimeout(this.timer);
    this.opened++; // discards answers to earlier requests, since a restarted scene has the same id
    Object.assign(this, { scene: null, model: null, asked: null, effective: null, timer: null, moving: false, updates: [] });
    this.say("");
    this.draw();
    this.place();
  }

  /** Reloads the data soon after a frame or another change, but not for every frame of a fast rig. */
  refresh(soonest = 0) {
    if (!this.scene || this.timer) return;
    this.timer = setTimeout(() => this.load(), Math.max(soonest, this.due - performance.now(), 0));
  }

  /** @param updates reports of all frames except the first, in order */
  follow(updates) {
    this.updates = updates.filter((one) => one.seconds?.total !== undefined);
    this.describe();
  }

  async load() {
    const { scene, opened } = this;
    this.due = performance.now() + EVERY_MS;
    try {
      const model = await call("GET", `${scenePath(scene)}/tradeoff`);
      const budget = await call("GET", `${scenePath(scene)}/budget`);
      if (this.opened !== opened) return;
      this.timer = null;
      this.show(model, budget);
    } catch {
      if (this.opened === opened) this.timer = null; // the page reports elsewhere that the service does not respond
    }
  }

  show(model, budget) {
    this.model = model;
    Object.assign(this, { requested: budget.requested, effective: budget.effective, since: budget.since });
    if (!this.moving) this.place();
    this.draw();
    const replay = model.replay;
    const running = replay.state === "running";
    this.$("measure").disabled = !running && !model.points.length;
    this.$("measure").textContent = running ? "Stop" : `Measure ${REPLAYED.slice(0, -1).join(", ")} and ${REPLAYED.at(-1)} iterations`;
    if (running) {
      this.say(`Replaying ${replay.frames.length} of the newest frames in the background: ${replay.done} of ${replay.total} updates.`);
      this.due = 0;
      this.refresh(REPLAY_EVERY_MS);
    } else if (replay.state === "failed") this.say(`The replay is incomplete: ${replay.error}.`, true);
    else if (replay.state === "done") {
      const which = replay.frames.length > 1 ? `frames ${replay.frames[0]} to ${replay.frames.at(-1)}` : `frame ${replay.frames[0]}`;
      this.say(`Replayed ${which} on ${replay.threads === 1 ? "one thread" : `${replay.threads} threads`}; replayed times are comparable only with each other.`);
    } else this.say("");
  }

  // The budget.

  get kind() {
    return this.$("budget-kind").value;
  }

  get value() {
    const [from, to] = RANGES[this.kind];
    const value = from * (to / from) ** (Number(this.$("budget").value) / STEPS);
    return this.kind === "iterations" ? Math.round(short(value)) : short(value);
  }

  /** Sets the control to the current budget, or to its value for the kind that was just chosen if `chosen` is true. */
  place(chosen = false) {
    const slider = this.$("budget");
    const [kind, effective] = [this.$("budget-kind"), this.effective];
    slider.disabled = kind.disabled = !effective;
    if (effective && !chosen) {
      kind.value = this.effectiveKind;
    }
    slider.hidden = this.$("budget-ends").hidden = !kind.value;
    if (kind.value) RANGES[kind.value].forEach((end, i) => { this.$("budget-ends").children[i].textContent = kind.value === "budget_ms" ? spoken(end) : end; });
    if (effective && kind.value) {
      const milliseconds = this.effective.budget_ms ?? this.milliseconds(this.effective.iterations) ?? 1000;
      const known = this.effective[kind.value] ?? (kind.value === "keep_up_fps" ? 1000 / milliseconds : milliseconds);
      const [from, to] = RANGES[kind.value];
      slider.value = Math.round(STEPS * Math.log(known / from) / Math.log(to / from));
    }
    this.describe();
    if (chosen && !kind.value) this.put();
  }

  milliseconds(iterations) {
    const model = this.model?.model;
    return model ? model.fixed + model.per_iteration * iterations : null;
  }

  /** Displays the value of the control and its cost or effect. */
  describe() {
    const words = this.$("budget-words");
    const effective = this.effective;
    this.$("budget-value").textContent = effective && this.kind ? `${this.value} ${UNITS[this.kind]}` : "";
    this.$("budget-effect").textContent = effective ? this.effect() : "";
    if (!effective) return words.textContent = "";
    const own = effective.keep_up_fps ? `keeping up with ${short(effective.keep_up_fps)} frames/s` : effective.budget_ms === null ? `${effective.iterations} iterations per frame` : `as many iterations as fit into ${spoken(effective.budget_ms)}`;
    const now = `Now: ${own}${this.requested.iterations === null && this.requested.budget_ms === null && !this.requested.keep_up_fps ? ", as the scene was created" : `, from frame ${this.since} on`}.`;
    const model = this.model?.model;
    let then = "";
    if (this.moving && model) {
      then = this.kind === "iterations" ? ` Then: about ${spoken(this.milliseconds(this.value))} per frame.`
        : ` Then: about ${Math.max(1, Math.round(((this.kind === "keep_up_fps" ? 1000 / this.value : this.value) - model.fixed) / model.per_iteration))} iterations per frame.`;
    }
    else if (this.kind && this.kind !== this.effectiveKind) then = " Move the slider to change it.";
    words.textContent = now + then;
  }

  /** Kind of the current budget, time or iterations; empty if it is the one with which the scene was created. */
  get effectiveKind() {
    return this.effective.keep_up_fps ? "keep_up_fps" : this.effective.budget_ms !== null ? "budget_ms" : this.requested.iterations !== null ? "iterations" : "";
  }

  /** Effect of the last change: the frames since then compared with those before. */
  effect() {
    if (!this.updates.length || this.since === null || this.since === undefined) return "";
    const after = this.updates.filter((one) => one.index >= this.since).slice(-EFFECT_FRAMES);
    const before = this.updates.filter((one) => one.index < this.since).slice(-EFFECT_FRAMES);
    if (!before.length) return "";
    if (!after.length) return `No frames since then; the ${before.length === 1 ? "one" : before.length} before: ${this.brought(before)}.`;
    return `Since then, ${after.length === 1 ? "one frame" : `${after.length} frames`}: ${this.brought(after)}; before: ${this.brought(before)}.`;
  }

  brought(updates) {
    const psnr = updates.map((one) => one.psnr).filter((value) => value !== null && value !== undefined);
    const time = spoken(1000 * median(updates.map((one) => one.seconds.total)));
    return psnr.length ? `${time}, ${median(psnr).toFixed(1)} dB per frame` : `${time} per frame`;
  }

  /** Resets the control to the current budget. */
  rest() {
    this.moving = false;
    this.place();
    this.draw();
  }

  async put() {
    const { scene, opened } = this;
    this.putting = true;
    const body = { ...this.requested, iterations: null, budget_ms: null, keep_up_fps: null };
    if (this.kind) body[this.kind] = this.value;
    try {
      const budget = await call("PUT", `${scenePath(scene)}/budget`, body);
      if (this.opened !== opened) return;
      Object.assign(this, { requested: budget.requested, effective: budget.effective, since: budget.since });
      this.rest();
    } catch (error) {
      this.moving = false;
      this.say(error.message, true);
    } finally {
      this.putting = false;
    }
  }

  /** Starts a replay, or stops the running one. */
  async measure() {
    const { opened } = this;
    const running = this.model?.replay.state === "running";
    const path = `${scenePath(this.scene)}/tradeoff`;
    try {
      const model = await (running ? call("DELETE", path) : call("POST", path, { iterations: REPLAYED }));
      if (this.opened !== opened) return;
      this.show(model, { requested: this.requested, effective: this.effective, since: this.since });
    } catch (error) {
      this.say(error.message, true);
    }
  }

  say(words, bad = false) {
    this.$("replay-words").textContent = words;
    this.$("replay-words").classList.toggle("warning", bad);
  }

  // The plot.

  draw() {
    const svg = this.$("tradeoff");
    const { clientWidth, clientHeight } = svg;
    svg.replaceChildren();
    const points = grouped(this.model?.points.filter((point) => point.iterations > 0) ?? []);
    // Without validation there are no probe views, so PSNR is used as the accuracy.
    const by = points.some((point) => point.error !== null) ? "error" : "psnr";
    const known = points.filter((point) => point[by] !== null);
    this.$("tradeoff-unit").textContent = by === "error" ? "error against time per frame" : "PSNR against time per frame";
    this.$("tradeoff-key").hidden = !known.length;
    if (!clientWidth) return;
    svg.setAttribute("viewBox", `0 0 ${clientWidth} ${clientHeight}`);
    if (!known.length) {
      element("text", { x: clientWidth / 2, y: clientHeight / 2 + 4, class: "empty" }, svg).textContent = "after the first update";
      return;
    }
    const width = clientWidth - LEFT - RIGHT;
    const height = clientHeight - TOP - STRIP - BOTTOM;
    const base = TOP + height + STRIP;
    const times = points.map((point) => point.milliseconds);
    const [first, last] = [Math.min(...times) / 1.15, Math.max(...times) * 1.15];
    const x = (time) => LEFT + Math.log(time / first) / Math.log(last / first) * width;
    const values = known.map((point) => point[by]);
    const pad = Math.max(0.15 * (Math.max(...values) - Math.min(...values)), 0.05 * Math.max(...values), 1e-9);
    const [low, high] = [Math.max(0, Math.min(...values) - pad), Math.max(...values) + pad];
    const y = (value) => TOP + (high - value) / (high - low) * height;
    const tick = step(high - low, 4);
    for (let value = Math.ceil(low / tick) * tick; value <= high; value += tick) {
      element("line", { x1: LEFT, x2: clientWidth - RIGHT, y1: y(value), y2: y(value), class: "grid" }, svg);
      element("text", { x: LEFT - 5, y: y(value) + 3.5, class: "label end" }, svg).textContent =
        value.toFixed(Math.max(0, -Math.floor(Math.log10(tick) + 1e-9)));
    }
    element("text", { x: 2, y: 11, class: "label start" }, svg).textContent =
      by === "error" ? "error of training views, lower is better" : "PSNR of training views, dB, higher is better";
    const unmeasured = points.some((point) => point[by] === null);
    if (unmeasured) element("text", { x: LEFT - 5, y: base - 7, class: "label end" }, svg).textContent = "unknown";
    element("rect", { x: LEFT, y: TOP + height + 8, width, height: STRIP - 8, class: "strip" }, svg);
    element("line", { x1: LEFT, x2: clientWidth - RIGHT, y1: base, y2: base, class: "axis" }, svg);
    for (let power = 10 ** Math.floor(Math.log10(first)); power < last; power *= 10) {
      for (const time of [power, 2 * power, 5 * power].filter((one) => one > first && one < last)) {
        element("line", { x1: x(time), x2: x(time), y1: base, y2: base + 4, class: "axis" }, svg);
        element("text", { x: x(time), y: clientHeight - 3, class: "label" }, svg).textContent = spoken(time);
      }
    }
    const chosen = this.chosen();
    if (chosen && chosen > first && chosen < last) {
      element("line", { x1: x(chosen), x2: x(chosen), y1: TOP - 3, y2: base, class: "chosen" }, svg);
      const [at, edge] = [x(chosen), 26];
      element("text", { x: Math.min(Math.max(at, LEFT + edge), clientWidth - edge), y: TOP - 6, class: "label budget" }, svg).textContent =
        this.moving ? "new budget" : "budget";
    }
    const replayed = known.filter((point) => point.kind === "replayed");
    if (replayed.length > 1) {
      const way = [...replayed].sort((a, b) => a.iterations - b.iterations);
      element("path", { d: way.map((one, i) => `${i ? "L" : "M"}${x(one.milliseconds)} ${y(one[by])}`).join(""), class: "way" }, svg);
    }
    const place = (point) => [x(point.milliseconds), point[by] === null ? base - 3 : y(point[by])];
    const taken = points.map((point) => place(point)).map(([px, py]) => [px - 4, px + 4, py - 4, py + 4]);
    if (chosen) taken.push([x(chosen) - 1, x(chosen) + 1, TOP, base]);
    /** Places a label beside its point if it covers nothing; otherwise, the point has it only as a title. */
    const label = (px, places, words) => {
      const half = 3.4 * words.length + 1;
      for (const [side, at] of places) {
        const middle = px + side * (half + 7);
        const box = [middle - half, middle + half, at - 9, at];
        if (taken.some((one) => one[0] < box[1] && box[0] < one[1] && one[2] < box[3] && box[2] < one[3])) continue;
        taken.push(box);
        element("text", { x: middle, y: at, class: "label" }, svg).textContent = words;
        return;
      }
    };
    for (const point of points) {
      const [px, py] = place(point);
      if (point.kind !== "extrapolated" && point[by] === null) continue;
      const shapes = {
        measured: ["circle", { cx: px, cy: py, r: 4.2 }],
        replayed: ["path", { d: `M${px} ${py - 5.2}l5.2 5.2l-5.2 5.2l-5.2 -5.2z` }],
        extrapolated: ["path", { d: `M${px} ${py - 8}l4 7.5h-8z` }],
      };
      const made = element(shapes[point.kind][0], { ...shapes[point.kind][1], class: `point ${point.kind}` }, svg);
      element("title", {}, made).textContent = this.words(point);
      // Labels of measured points go below, the others above, since both often have the same number of iterations.
      const above = { measured: 8, replayed: 9, extrapolated: 12 }[point.kind];
      const [over, under, beside] = [[0, py - above], [0, py + 16], py + 4];
      const places = { measured: [under, over], replayed: [over, under], extrapolated: [over] }[point.kind];
      label(px, [...places, [1, beside], [-1, beside]], point.from < point.to ? `${point.from}–${point.to}` : `${point.iterations}`);
    }
  }

  chosen() {
    if (!this.effective) return null;
    const kind = this.moving ? this.kind : null;
    if (kind === "budget_ms") return this.value;
    if (kind === "iterations") return this.milliseconds(this.value);
    return this.effective.budget_ms ?? this.milliseconds(this.effective.iterations);
  }

  words(point) {
    const figures = [point.from < point.to ? `${point.from} to ${point.to} iterations` : `${point.iterations} iterations`, `${spoken(point.milliseconds)} per frame`];
    if (point.error !== null) figures.push(`error ${point.error.toFixed(4)}`);
    if (point.psnr !== null) figures.push(`${point.psnr.toFixed(1)} dB`);
    const from = point.frames ? `, ${point.frames} ${point.frames === 1 ? "frame" : "frames"}` : "";
    const threads = point.threads ? `, ${point.threads} ${point.threads === 1 ? "thread" : "threads"}` : "";
    return `${figures.join(", ")} (${HOW[point.kind]}${from}${threads})`;
  }
}
