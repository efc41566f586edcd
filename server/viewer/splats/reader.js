// Reader of a compact 4D file in memory, frame by frame in any order; the file may be truncated, or grow while it is read.

import { BORN, DELTA, FileError, HEAD_SIZE, KEY, PARTS, bodyOf, list, readHead } from "./records.js";
import { Sections } from "./planes.js";
import { appended, decodeBorn, decodeState, extended } from "./states.js";

const MOST_PER_BYTE = 4; // maximum Gaussians per byte, so that an invalid count does not exhaust the memory
const MOST_GROWN = 32e6; // bytes of a growing file above which its older half is removed

export class CompactReader {
  /** @param bytes Uint8Array with the whole file or its beginning */
  constructor(bytes) {
    this.bytes = bytes;
    this.read(list(bytes));
    this.forget();
  }

  read({ records, damage }) {
    this.records = records;
    this.head ??= readHead(this.bytes, records[0]);
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
  }

  /** Appends complete records; if the file becomes too large, its older states are removed. */
  append(more) {
    const size = this.bytes.length;
    const all = this.bytes.byteOffset + size + more.length;
    if (all > this.bytes.buffer.byteLength) {
      const grown = new Uint8Array(2 * all);
      grown.set(this.bytes);
      this.bytes = grown.subarray(0, size);
    }
    this.bytes = new Uint8Array(this.bytes.buffer, this.bytes.byteOffset, size + more.length);
    this.bytes.set(more, size);
    const { records, damage } = list(this.bytes, size);
    if (damage) throw new FileError(damage);
    this.read({ records: [...this.records, ...records], damage });
    if (this.bytes.length > MOST_GROWN) this.trim();
  }

  /** Removes the older half of the states, up to a key frame; the first record of newborn Gaussians is also a state and stays. */
  trim() {
    const key = this.states.findIndex(({ kind }, place) => place >= this.states.length / 2 && kind === KEY);
    const removed = new Set(this.states.slice(1, Math.max(key, 1)));
    const kept = this.records.filter((record) => !removed.has(record));
    const bytes = new Uint8Array(kept.reduce((sum, { size }) => sum + HEAD_SIZE + size, 0));
    let at = 0;
    for (const { offset, size } of kept) {
      bytes.set(this.bytes.subarray(offset - HEAD_SIZE, offset + size), at);
      at += HEAD_SIZE + size;
    }
    this.bytes = bytes;
    this.read(list(bytes));
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
