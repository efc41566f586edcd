// Reader of a compact 4D file in memory, frame by frame in any order; the file may be truncated.

import { BORN, DELTA, FileError, KEY, PARTS, bodyOf, list, readHead } from "./records.js";
import { Sections } from "./planes.js";
import { appended, decodeBorn, decodeState, extended } from "./states.js";

const MOST_PER_BYTE = 4; // maximum Gaussians per byte, so that an invalid count does not exhaust the memory

export class CompactReader {
  /** @param bytes Uint8Array with the whole file or its beginning */
  constructor(bytes) {
    this.bytes = bytes;
    const { records, damage } = list(bytes);
    this.head = readHead(bytes, records[0]);
    this.damage = damage;
    this.births = records.filter((record) => record.kind === BORN);
    this.partRecords = records.filter((record) => record.kind === PARTS);
    this.states = []; // state records of the frames, in order
    for (const record of records) {
      if (record.kind === KEY || record.kind === DELTA || (record.kind === BORN && !this.states.length)) this.states.push(record);
    }
    if (!this.states.length) throw new FileError(`the file has no frames${damage ? `: ${damage}` : ""}`);
    this.frames = this.states.map((record) => record.frame);
    this.times = this.states.map((record) => record.time);
    this.forget();
  }

  /** Discards decoded data, which is decoded again on demand. */
  forget() {
    this.born = { decoded: 0, state: null, clusters: null, gloss: -1 };
    this.last = { place: -1, state: null };
  }

  /** Total number of Gaussians up to the last frame. */
  get count() {
    const view = new DataView(this.bytes.buffer, this.bytes.byteOffset);
    return this.births.reduce((sum, record) => sum + view.getUint32(record.offset, true), 0);
  }

  /** State at an index into `frames`; its arrays must not be modified. */
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
      if (new Sections(body).word() !== this.states[place - 1].checksum) throw new FileError(`frame ${record.frame} is encoded relative to another state`);
      if (before) reference = before.count < born.state.count ? extended(before, born.state) : before;
    }
    return decodeState(body, at, reference, born.clusters, this.head.bounds, born.gloss);
  }

  /** All Gaussians born up to a frame, as they were at birth. */
  bornBy(frame) {
    const wanted = this.births.filter((record) => record.frame <= frame);
    if (!wanted.length) throw new FileError(`the Gaussians of frame ${frame} are missing`);
    if (this.born.decoded > wanted.length) this.born = { decoded: 0, state: null, clusters: null, gloss: -1 };
    while (this.born.decoded < wanted.length) {
      const body = bodyOf(this.bytes, wanted[this.born.decoded]);
      const count = new Sections(body).word();
      if (count > MOST_PER_BYTE * body.length + 1024) throw new FileError(`${count} Gaussians cannot fit into ${body.length} bytes`);
      const own = decodeBorn(body, 4, count, this.head.bounds);
      const { state, clusters, decoded, gloss } = this.born;
      this.born = state
        ? { decoded: decoded + 1, state: appended(state, own.state), clusters: Int32Array.from([...clusters, ...own.clusters]), gloss }
        : { decoded: decoded + 1, ...own };
    }
    return this.born;
  }

  /** [N] latest part of each Gaussian, −1 for none; null if the file has no parts. */
  parts() {
    const record = this.partRecords.at(-1);
    if (!record) return null;
    const sections = new Sections(bodyOf(this.bytes, record));
    const count = sections.word();
    if (count > this.count) throw new FileError(`the file has parts of ${count} Gaussians, but only ${this.count} Gaussians`);
    return sections.plane(count).map((value) => value - 1);
  }
}
