// The frames of one compact file or of several, in the order of their indices; decoded ones are kept within a bound.

const MOST_BYTES = 256e6; // of decoded states
const PER_GAUSSIAN = 88; // bytes of a state, where nothing is shared
const MOST_FILES_BYTES = 384e6;
const READY = 3; // files that keep what they need for their next frame

export class Sequence {
  constructor() {
    this.frames = []; // { index, time, reader, place }, rising
    this.kept = new Map(); // decoded states by index, the one used last at the end
    this.ready = new Set(); // readers, the one used last at the end
    this.head = null;
  }

  /** Takes the frames of a file; those that are known already are told by it from now on. */
  add(reader) {
    this.head ??= reader.head;
    const fresh = reader.frames.map((index, place) => ({ index, time: reader.times[place], reader, place }));
    const known = new Set(reader.frames);
    for (const index of known) this.kept.delete(index);
    this.frames = [...this.frames.filter((frame) => !known.has(frame.index)), ...fresh].sort((a, b) => a.index - b.index);
    this.bound(reader);
  }

  /** Forgets the oldest files beyond a bound of memory, but never the one that just came. */
  bound(newest) {
    const sizes = new Map(this.frames.map((frame) => [frame.reader, frame.reader.bytes.length]));
    let sum = [...sizes.values()].reduce((a, b) => a + b, 0);
    for (const [reader, size] of sizes) {
      if (sum <= MOST_FILES_BYTES || reader === newest) break;
      this.frames = this.frames.filter((frame) => frame.reader !== reader);
      sum -= size;
    }
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

  /** The moment at a place between frames: 1.25 is a quarter of the way from the second to the third. */
  moment(place) {
    const last = this.frames.length - 1;
    const at = Math.max(0, Math.min(last, place));
    const from = this.state(Math.floor(at));
    const share = at - Math.floor(at);
    if (share < 1e-4) return { from, to: null, share: 0 };
    const to = this.state(Math.floor(at) + 1);
    return to.count < from.count ? { from, to: null, share: 0 } : { from, to, share };
  }
}
