// The frames of one compact file or of several, in the order of their indices; decoded ones are kept within a bound.

const MOST_BYTES = 256e6; // of decoded states
const PER_GAUSSIAN = 88; // bytes of a state, where nothing is shared
const MOST_FILES_BYTES = 384e6;
const READY = 3; // files that keep what they need for their next frame

export class Sequence {
  /** @param most bytes of files that are kept; Infinity where none can be fetched again */
  constructor(most = MOST_FILES_BYTES) {
    this.most = most;
    this.frames = []; // { index, time, reader, place }, rising
    this.kept = new Map(); // decoded states by index, the one used last at the end
    this.ready = new Set(); // readers, the one used last at the end
    this.used = new Set(); // readers of files, the one that came or was shown last at the end
    this.shown = new Set(); // readers of what is shown
    this.head = null;
  }

  /** Takes the frames of a file; frames that are known already are read from it from now on. */
  add(reader) {
    this.head ??= reader.head;
    const fresh = reader.frames.map((index, place) => ({ index, time: reader.times[place], reader, place }));
    const known = new Set(reader.frames);
    for (const index of known) this.kept.delete(index);
    this.frames = [...this.frames.filter((frame) => !known.has(frame.index)), ...fresh].sort((a, b) => a.index - b.index);
    this.used.add(reader);
    this.bound(reader);
  }

  /** Forgets files beyond a bound of memory, those first that were shown longest ago; never the newest, nor what is shown. */
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

  /** Whether the state of a frame, by its place, is decoded. */
  has(place) {
    return this.kept.has(this.frames[place]?.index);
  }

  state(place) {
    const { index, reader, place: inFile } = this.frames[place];
    let state = this.kept.get(index);
    if (state) this.kept.delete(index); // and in again, as the last used
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

  /** The place of a moment on the way from a frame to the next one; null where the frame is not there. */
  placeOf(index, next, share) {
    const place = this.frames.findIndex((frame) => frame.index === index);
    if (place < 0) return null;
    return next !== null && this.frames[place + 1]?.index === next ? place + share : place;
  }

  /** The moment at a place between frames: 1.25 is a quarter of the way from the second to the third. */
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
