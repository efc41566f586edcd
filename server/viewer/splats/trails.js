// Trails: where many Gaussians are in each frame, gathered frame by frame beside the drawing.

import { CompactReader } from "./reader.js";

const MOST = 4096;

/** Rows of Gaussians for trails: of those that move, so many, evenly over their order; the same ones each time. */
export function chosen(state, count, hidden) {
  const moving = [];
  for (let i = 0; i < state.count; i++) if (state.foreground[i] > 0.5 && !state.retired[i] && !hidden?.[i]) moving.push(i);
  const wanted = Math.min(count, moving.length, MOST);
  // Rows beside each other are often neighbours: a step of the golden ratio spreads them.
  const step = 0.618033988749895 * moving.length;
  const rows = new Set();
  for (let k = 0; rows.size < wanted; k++) rows.add(moving[Math.floor((k * step) % moving.length)]);
  return Uint32Array.from(rows).sort();
}

/** [3 × rows] 0…255: a hue by the direction from the middle of all, so that neighbours have like ones. */
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

/** Where the Gaussians with trails are in each frame that was gathered, by its index. */
export class Ways {
  constructor() {
    this.clear();
  }

  clear() {
    this.rows = new Uint32Array(0);
    this.hues = new Uint8Array(0);
    this.centres = new Map();
  }

  /** Chooses the Gaussians, by the state of a frame. */
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

  /** Forgets the frames that are not among these. */
  keep(frames) {
    const wanted = new Set(frames.map(({ index }) => index));
    for (const index of this.centres.keys()) if (!wanted.has(index)) this.centres.delete(index);
  }
}

/** Whether each frame follows the one before without a gap: in the same file, or no farther than is usual among these. */
export function joined(frames) {
  const steps = frames.slice(1).map(({ index }, k) => index - frames[k].index);
  const usual = [...steps].sort((a, b) => a - b)[Math.floor(steps.length / 2)];
  return frames.map(({ reader }, place) => place > 0 && (reader === frames[place - 1].reader || steps[place - 1] <= usual));
}

/** Goes through all frames of a sequence, one a turn, so that pictures come between; a later walk ends an earlier one. */
export class Walk {
  constructor() {
    this.number = 0;
  }

  stop() {
    this.number++;
  }

  /**
   * @param each (state, place) of every frame  @param done called after the last
   * @param failed (error) of the first frame that cannot be read; those that can are gone on with
   * @param known (place) whether a frame is passed over
   */
  begin(sequence, each, done, failed, known = () => false) {
    const number = ++this.number;
    const readers = new Map(); // of its own: one that goes from frame to frame is not thrown back by what is drawn
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
