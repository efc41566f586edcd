// Reads a compact 4D file from memory, frame by frame in any order; also one that was cut.

import { BORN, DELTA, FileError, KEY, PARTS, bodyOf, list, readHead } from "./records.js";
import { Sections } from "./planes.js";
import { appended, decodeBorn, decodeState, extended } from "./states.js";

const MOST_PER_BYTE = 4; // Gaussians per byte at most; a wrong count must not fill the memory

export class CompactReader {
  /** @param bytes Uint8Array, the whole file or the part of it that is there */
  constructor(bytes) {
    this.bytes = bytes;
    const { records, damage } = list(bytes);
    this.head = readHead(bytes, records[0]);
    this.damage = damage;
    this.births = records.filter((record) => record.kind === BORN);
    this.partRecords = records.filter((record) => record.kind === PARTS);
    this.states = []; // of the frames, in their order
    for (const record of records) {
      if (record.kind === KEY || record.kind === DELTA || (record.kind === BORN && !this.states.length)) this.states.push(record);
    }
    if (!this.states.length) throw new FileError(`the file has no frame${damage ? `: ${damage}` : ""}`);
    this.frames = this.states.map((record) => record.frame);
    this.times = this.states.map((record) => record.time);
    this.forget();
  }

  /** Lets go of what is decoded; it is decoded again when it is asked for. */
  forget() {
    this.born = { decoded: 0, state: null, clusters: null, gloss: -1 };
    this.last = { place: -1, state: null };
  }

  /** Gaussians that there have been by the last frame. */
  get count() {
    const view = new DataView(this.bytes.buffer, this.bytes.byteOffset);
    return this.births.reduce((sum, record) => sum + view.getUint32(record.offset, true), 0);
  }

  /** The state at a place of `frames`; its arrays must not be written to. */
  state(place) {
    let begin = place;
    while (begin > 0 && this.states[begin].kind === DELTA && this.last.place !== begin) begin--;
    let state = this.last.place === begin ? this.last.state : null;
    for (let one = state ? begin + 1 : begin; one <= place; one++) {
      state = this.decoded(one, state);
      this.last = { place: one, state };
    }
    return state;
  }

  decoded(place, before) {
    const record = this.states[place];
    const born = this.bornBy(record.frame);
    if (record.kind === BORN) return born.state;
    const body = bodyOf(this.bytes, record);
    let at = 0;
    let reference = born.state;
    if (record.kind === DELTA) {
      at = 4;
      if (new Sections(body).word() !== this.states[place - 1].checksum) throw new FileError(`frame ${record.frame} is coded against another state`);
      if (before) reference = before.count < born.state.count ? extended(before, born.state) : before;
    }
    return decodeState(body, at, reference, born.clusters, this.head.bounds, born.gloss);
  }

  /** All Gaussians that are born by a frame, as they were coded then. */
  bornBy(frame) {
    const wanted = this.births.filter((record) => record.frame <= frame);
    if (!wanted.length) throw new FileError(`the Gaussians of frame ${frame} are missing`);
    if (this.born.decoded > wanted.length) this.born = { decoded: 0, state: null, clusters: null, gloss: -1 };
    while (this.born.decoded < wanted.length) {
      const body = bodyOf(this.bytes, wanted[this.born.decoded]);
      const count = new Sections(body).word();
      if (count > MOST_PER_BYTE * body.length + 1024) throw new FileError(`${count} Gaussians in ${body.length} bytes cannot be`);
      const own = decodeBorn(body, 4, count, this.head.bounds);
      const { state, clusters, decoded, gloss } = this.born;
      this.born = state
        ? { decoded: decoded + 1, state: appended(state, own.state), clusters: Int32Array.from([...clusters, ...own.clusters]), gloss }
        : { decoded: decoded + 1, ...own };
    }
    return this.born;
  }

  /** [N] part of each Gaussian, −1 for none, as it was last seen; null where none was. */
  parts() {
    const record = this.partRecords.at(-1);
    if (!record) return null;
    const sections = new Sections(bodyOf(this.bytes, record));
    const count = sections.word();
    if (count > this.count) throw new FileError(`parts of ${count} Gaussians, there are ${this.count}`);
    return sections.plane(count).map((value) => value - 1);
  }
}
