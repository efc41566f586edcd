// Worker that decodes compact files and paints their Gaussians, to keep both off the page's thread.
// It receives and sends messages { kind, … }; see `Splats`, which is the page's side.

import { Painter } from "./painter.js";
import { ROW } from "./programs.js";
import { CompactReader } from "./reader.js";
import { inside, nearOf, outside, partColour } from "./rig.js";
import { Sequence } from "./sequence.js";
import { Rasterizer } from "./software.js";
import { Sorter } from "./sort.js";
import { TEXELS, interleave } from "./texels.js";
import { Ways, Walk } from "./trails.js";

const NOTHING = [16 / 255, 19 / 255, 24 / 255]; // colour in depth pictures where there is nothing
const NO_PART = [90, 96, 104];
const post = (kind, message = {}, transferred = []) => self.postMessage({ kind, ...message }, transferred);

const [sorter, rasterizer] = [new Sorter(), new Rasterizer()];
const [trailWalk, trackWalk] = [new Walk(), new Walk()];
const ways = new Ways();
let painter = null;
let sequence = new Sequence();
let most; // maximum bytes of files to keep, if the page sets it
let live = null; // reader of the live states, which grows
let near = 0;
let labels = null; // part of each Gaussian
let shown = null; // last picture: { camera, moment }
let look = { mode: "colour", background: null, hiddenParts: [], trails: 0, span: 20 };
let cover = null; // mask of hidden Gaussians, from `hiddenParts`
let paints = null; // RGBA colours of the Gaussians by their parts
let followed = -1;
const numbers = new WeakMap(); // of the arrays and states that the page may keep
let numbered = 0;

const actions = {
  canvas({ canvas, mostBytes }) {
    most = mostBytes;
    sequence = new Sequence(most);
    painter = new Painter(canvas);
    post("ready", { floats: painter.floats });
  },

  /** Resets the worker, removing all frames. */
  clear() {
    trackWalk.stop();
    forgetTrails();
    sequence = new Sequence(most);
    labels = shown = cover = live = null;
    followed = -1;
  },

  file({ bytes, name }) {
    added(new CompactReader(bytes), name);
  },

  /** Adds live states; `starts` means that they do not continue the previous ones. */
  live({ bytes, name, starts }) {
    if (starts) live = new CompactReader(bytes);
    else live.append(bytes);
    added(live, name, true);
  },

  look(changes) {
    const before = look;
    look = { ...look, ...changes };
    const hidden = new Set(look.hiddenParts);
    cover = labels && hidden.size ? Uint8Array.from(labels, (label) => (hidden.has(label) ? 1 : 0)) : null;
    if (look.trails === before.trails && !(look.trails && changes.hiddenParts)) return;
    forgetTrails();
    guarded("trails", gatherTrails);
  },

  draw({ camera: model, ...asked }) {
    const began = performance.now();
    const place = placeOf(asked);
    if (place === null) return post("failed", { during: "draw", gone: true, words: `frame ${asked.index} is no longer loaded` });
    const ahead = asked.index === undefined ? asked.ahead : asked.next === null ? undefined : Math.floor(place) + 2;
    const { head } = sequence;
    const camera = inside(model, head, near);
    const moment = sequence.moment(place);
    const [decoded, { mode }] = [performance.now(), look];
    const count = (moment.to ?? moment.from).count;
    sorter.sort(moment, camera.rows[2], covering(count));
    painter.size(camera.width, camera.height);
    const background = backgroundOf(mode);
    const given = [moment, camera, sorter, paintOf(mode, count)];
    let range = null;
    if (mode === "depth") { // also in software, since it is rarely shown
      painter.project(...given);
      range = painter.range();
      painter.depth(range, NOTHING);
    } else if (painter.software) painter.show(rasterizer.paint(...given, background));
    else {
      painter.project(...given);
      painter.colours(background);
    }
    if (look.trails) painter.paintTrails(camera, place, look.span);
    painter.finish();
    shown = { camera, moment };
    const [metres, now] = [head.world.metres_per_unit, performance.now()];
    post("drawn", { place, mode, milliseconds: now - began, decoding: decoded - began,
      range: range?.map((z) => z / metres), followed: followed < 0 ? null : whereIs(followed) });
    if (ahead === undefined || ahead >= sequence.frames.length || sequence.has(ahead)) return;
    setTimeout(() => guarded("ahead", () => sequence.frames[ahead] && sequence.state(ahead)));
  },

  /** Sorts the Gaussians of a moment, which the page paints itself; `known` are the numbers of the states and colours that it has. */
  sort({ axis, known, ...asked }) {
    const place = placeOf(asked);
    if (place === null) return post("sorted");
    const { from, to, share } = sequence.moment(place);
    const { count } = to ?? from;
    sorter.sort({ from, to, share }, axis, covering(count));
    const order = sorter.order.slice(0, ROW * Math.ceil(sorter.count / ROW));
    const transferred = [order.buffer];
    const sent = (value, contents) => {
      if (!numbers.has(value)) numbers.set(value, ++numbered);
      const number = numbers.get(value);
      return { number, count: value.count, ...(known.includes(number) ? {} : contents(value)) };
    };
    const withTexels = (state) => {
      const texels = interleave(state, new Float32Array(4 * TEXELS * ROW * Math.ceil(state.count / ROW)));
      transferred.push(texels.buffer);
      return { texels };
    };
    const mode = look.mode === "depth" ? "colour" : look.mode;
    const paint = paintOf(mode, count);
    const { world } = sequence.head;
    post("sorted", { from: sent(from, withTexels), to: to && sent(to, withTexels), share, order, count: sorter.count, near, world,
      background: backgroundOf(mode), paint: typeof paint === "string" ? paint : sent(paint, (values) => ({ values })) }, transferred);
  },

  /** Follows the Gaussian at a point of the last picture. */
  pick({ u, v }) {
    if (!shown) return;
    painter.project(shown.moment, shown.camera, sorter, "own");
    const place = painter.at(u, v);
    if (place < 0) return post("picked", { row: -1 });
    actions.follow({ row: sorter.order[place] });
  },

  follow({ row }) {
    followed = row;
    trackWalk.stop();
    if (row < 0 || !shown) return;
    const { head } = sequence;
    post("picked", { row, id: (shown.moment.to ?? shown.moment.from).ids[row], part: labels?.[row] ?? -1, at: whereIs(row) });
    const track = [];
    trackWalk.begin(sequence, (state, place) => {
      const there = row < state.count && !state.retired[row];
      track.push(there ? [place, outside(centreOf(state, row), head)] : [place, null]);
    }, () => post("track", { row, track }), (error) => failed("track", error));
  },
};

/** Adds the frames of a reader to the sequence and reports all frames. */
function added(reader, name, isLive = false) {
  sequence.add(reader);
  near = nearOf(sequence.head);
  const found = reader.parts();
  if (found) {
    labels = found;
    paints = null;
    actions.look({});
  }
  if (look.trails) {
    if (found && look.hiddenParts.length) forgetTrails(); // the hidden Gaussians have changed
    guarded("trails", gatherTrails); // the places of frames have changed
  }
  const parts = labels ? Math.max(-1, ...new Set(labels)) + 1 : 0;
  post("frames", { name, live: isLive, frames: sequence.frames.map(({ index, time }) => [index, time]), head: sequence.head, count: reader.count,
    parts, damage: reader.damage });
}

const placeOf = ({ place, index, next, share }) => place ?? sequence.placeOf(index, next, share);
const backgroundOf = (mode) => (mode === "colour" ? look.background ?? sequence.head.background : [0, 0, 0]);
const centreOf = ({ means, count }, row) => [0, 1, 2].map((k) => means[k * count + row]);

function whereIs(row) {
  const { from, to, share } = shown.moment;
  const there = (state) => state && row < state.count && !state.retired[row];
  if (!there(from)) return there(to) ? outside(centreOf(to, row), sequence.head) : null;
  const [begin, end] = [centreOf(from, row), there(to) ? centreOf(to, row) : null];
  return outside(end ? begin.map((value, k) => value + share * (end[k] - value)) : begin, sequence.head);
}

function covering(count) {
  if (!cover || cover.length >= count) return cover;
  const all = new Uint8Array(count); // includes Gaussians born after the parts were computed
  all.set(cover);
  return (cover = all);
}

/** What replaces the Gaussians' own colours; see `Painter.project`. */
function paintOf(mode, count) {
  if (mode === "alpha") return "white";
  if (mode !== "parts" || !labels) return "own";
  if (paints?.length === 4 * count) return paints;
  const table = new Map();
  paints = new Uint8Array(4 * count);
  for (let i = 0; i < count; i++) {
    const label = labels[i] ?? -1;
    if (!table.has(label)) table.set(label, label < 0 ? NO_PART : partColour(label));
    paints.set(table.get(label), 4 * i);
  }
  return paints;
}

function forgetTrails() {
  trailWalk.stop();
  ways.clear();
  painter?.endTrails();
}

/** Gathers the centres of the Gaussians with trails, frame by frame, skipping known frames. */
function gatherTrails() {
  trailWalk.stop();
  if (!sequence.frames.length || !painter || !look.trails) return;
  if (!ways.rows.length) {
    const first = sequence.state(0);
    ways.begin(first, Math.min(look.trails, painter.most), covering(first.count));
  }
  if (!ways.rows.length) return;
  ways.keep(sequence.frames);
  painter.placeTrails(ways, sequence.frames);
  trailWalk.begin(sequence, (state, place) => {
    ways.add(sequence.frames[place].index, state);
    painter.placeTrails(ways, sequence.frames);
  }, () => post("trails", { count: ways.rows.length }), (error) => failed("trails", error), (place) => ways.has(sequence.frames[place].index));
}

function failed(during, error, name) {
  post("failed", { during, name, words: error.message });
}

/** Runs an action; errors are reported and affect nothing else. */
function guarded(during, action, name) {
  try {
    action();
  } catch (error) {
    failed(during, error, name);
  }
}

self.onmessage = ({ data }) => guarded(data.kind, () => actions[data.kind](data), data.name);
