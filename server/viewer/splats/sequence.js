// Frames of one or more compact files, ordered by index, with a bounded cache of decoded states.

const MOST_BYTES = 256e6; // maximum bytes of decoded states
const PER_GAUSSIAN = 88; // bytes of a state per Gaussian if nothing is shared
const MOST_FILES_BYTES = 384e6;
const READY = 3; // number of files that keep the data needed to decode their next frame

export class Sequence {
  /** @param most maximum bytes of files to keep; Infinity if files cannot be fetched again */
  constructor(most = MOST_FILES_BYTES) {
    this.most = most;
    this.frames = []; // { index, time, reader, place }, in ascending order
    this.kept = new Map(); // decoded states keyed by index, least recently used first
    this.ready = new Set(); // readers, least recently used first
    this.used = new Set(); // readers of files, least recently added or shown first
    this.shown = new Set(); // readers of the frames that are shown
    this.head = null;
  }

  /** Adds the frames of a file, or the new ones of a file that has grown; from now on, they are read from this file. */
  add(reader) {
    this.head ??= reader.head;
    const fresh = reader.frames.map((index, place) => ({ index, time: reader.times[place], reader, place }));
    const found = new Set(reader.frames);
    const others = this.frames.filter((frame) => frame.reader !== reader);
    for (const { index } of others) if (found.has(index)) this.kept.delete(index);
    this.frames = [...others.filter((frame) => !found.has(frame.index)), ...fresh].sort((a, b) => a.index - b.index);
    this.used.add(reader);
    this.bound(reader);
  }

  /** Removes files beyond the memory limit, least recently shown first, except the newest one and those that are shown. */
  bound(newest) {
    const inUse = new Set(this.frames.map((frame) => frame.reader));
    for (const reader of this.used) if (!inUse.has(reader)) this.drop(reader);
    let sum = 0;
    for (const reader of this.used) sum += reader.bytes.length;
    for (const reader of this.used) {
      if (sum <= this.most) break;
      if (reader === newest || this.shown.has(reader)) continue;
      this.drop(reader);
      sum -= reader.bytes.length;
    }
  }

  drop(reader) {
    for (const readers of [this.used, this.ready, this.shown]) readers.delete(reader);
    for (const { index } of this.frames.filter((frame) => frame.reader === reader)) this.kept.delete(index);
    this.frames = this.frames.filter((frame) => frame.reader !== reader);
  }

  /** Whether the state of the frame at a place is decoded. */
  has(place) {
    return this.kept.has(this.frames[place]?.index);
  }

  state(place) {
    const { index, reader, place: inFile } = this.frames[place];
    let state = this.kept.get(index);
    if (state) this.kept.delete(index); // inserted again as the most recently used
    else state = this.decoded(reader, inFile);
    this.kept.set(index, state);
    const most = Math.max(3, Math.floor(MOST_BYTES / (PER_GAUSSIAN * state.count)));
    while (this.kept.size > most) this.kept.delete(this.kept.keys().next().value);
    return state;
  }

  decoded(reader, place) {
    this.ready.delete(reader);
    this.ready.add(reader);
    if (this.ready.size > READY) {
      const [oldest] = this.ready;
      this.ready.delete(oldest);
      oldest.forget();
    }
    return reader.state(place);
  }

  /** Place of a moment between a frame and the next one; null if the frame is not available. */
  placeOf(index, next, share) {
    const place = this.frames.findIndex((frame) => frame.index === index);
    if (place < 0) return null;
    return next !== null && this.frames[place + 1]?.index === next ? place + share : place;
  }

  /** Moment at a fractional place: 1.25 is a quarter of the way from the second frame to the third. */
  moment(place) {
    const last = this.frames.length - 1;
    const at = Math.max(0, Math.min(last, place));
    const from = this.state(Math.floor(at));
    const share = at - Math.floor(at);
    this.shown = new Set([Math.floor(at), Math.ceil(at)].map((one) => this.frames[one].reader));
    for (const reader of this.shown) this.used.delete(reader), this.used.add(reader);
    if (share < 1e-4) return { from, to: null, share: 0 };
    const to = this.state(Math.floor(at) + 1);
    return to.count < from.count ? { from, to: null, share: 0 } : { from, to, share };
  }
}
