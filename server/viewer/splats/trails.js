// Trails: positions of many Gaussians in each frame, gathered frame by frame while pictures are drawn.

import { CompactReader } from "./reader.js";

const MOST = 4096;

/** Rows of up to `count` moving Gaussians for trails, evenly spread over their order; deterministic. */
export function chosen(state, count, hidden) {
  const moving = [];
  for (let i = 0; i < state.count; i++) if (state.foreground[i] > 0.5 && !state.retired[i] && !hidden?.[i]) moving.push(i);
  const wanted = Math.min(count, moving.length, MOST);
  // Adjacent rows are often neighbours in space; steps of the golden ratio spread them.
  const step = 0.618033988749895 * moving.length;
  const rows = new Set();
  for (let k = 0; rows.size < wanted; k++) rows.add(moving[Math.floor((k * step) % moving.length)]);
  return Uint32Array.from(rows).sort();
}

/** [3 × rows] colours 0…255 by direction from the common centre, so that neighbours have similar hues. */
export function huesOf(state, rows) {
  const { count, means } = state;
  const middle = [0, 1, 2].map((k) => rows.reduce((sum, row) => sum + means[k * count + row], 0) / Math.max(rows.length, 1));
  const hues = new Uint8Array(3 * rows.length);
  rows.forEach((row, i) => {
    const [x, y, z] = [0, 1, 2].map((k) => means[k * count + row] - middle[k]);
    const turn = Math.atan2(z, x) / (2 * Math.PI) + 0.15 * y;
    for (let k = 0; k < 3; k++) hues[3 * i + k] = 150 + 105 * Math.cos(2 * Math.PI * (turn + k / 3));
  });
  return hues;
}

/** Positions of the Gaussians with trails in each gathered frame, keyed by frame index. */
export class Ways {
  constructor() {
    this.clear();
  }

  clear() {
    this.rows = new Uint32Array(0);
    this.hues = new Uint8Array(0);
    this.centres = new Map();
  }

  /** Chooses the Gaussians from the state of a frame. */
  begin(state, count, hidden) {
    this.rows = chosen(state, count, hidden);
    this.hues = huesOf(state, this.rows);
  }

  has(index) {
    return this.centres.has(index);
  }

  add(index, state) {
    const texels = new Float32Array(4 * this.rows.length);
    this.rows.forEach((row, i) => {
      if (row >= state.count || state.retired[row]) return;
      for (let k = 0; k < 3; k++) texels[4 * i + k] = state.means[k * state.count + row];
      texels[4 * i + 3] = 1;
    });
    this.centres.set(index, texels);
  }

  /** Removes all frames except these. */
  keep(frames) {
    const wanted = new Set(frames.map(({ index }) => index));
    for (const index of this.centres.keys()) if (!wanted.has(index)) this.centres.delete(index);
  }
}

/** Whether each frame follows the previous one without a gap: in the same file, or at most the median step away. */
export function joined(frames) {
  const steps = frames.slice(1).map(({ index }, k) => index - frames[k].index);
  const usual = [...steps].sort((a, b) => a - b)[Math.floor(steps.length / 2)];
  return frames.map(({ reader }, place) => place > 0 && (reader === frames[place - 1].reader || steps[place - 1] <= usual));
}

/** Visits all frames of a sequence, one per task, so that pictures are drawn in between; a new walk ends the previous one. */
export class Walk {
  constructor() {
    this.number = 0;
  }

  stop() {
    this.number++;
  }

  /**
   * @param each (state, place) called for every frame  @param done called after the last frame
   * @param failed (error) called for the first frame that cannot be read; the walk continues
   * @param known (place) returns whether to skip a frame
   */
  begin(sequence, each, done, failed, known = () => false) {
    const number = ++this.number;
    const readers = new Map(); // own reader, so that decoding in order is not disturbed by the frames that are drawn
    let place = 0;
    let whole = true;
    const step = () => {
      if (number !== this.number) return;
      while (place < sequence.frames.length && known(place)) place++;
      if (place >= sequence.frames.length) return done();
      const { reader, place: inFile } = sequence.frames[place];
      try {
        if (!readers.has(reader)) readers.clear(), readers.set(reader, new CompactReader(reader.bytes));
        each(sequence.has(place) ? sequence.state(place) : readers.get(reader).state(inFile), place);
      } catch (error) {
        if (whole) failed(error);
        whole = false;
      }
      place++;
      setTimeout(step);
    };
    setTimeout(step);
  }
}
