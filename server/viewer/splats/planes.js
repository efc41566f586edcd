// Planes and sections of a compact 4D file (docs/format.md): bit-packed integers, compressed with Zstandard.

import { decompress } from "../vendor/fzstd.js";
import { FileError } from "./records.js";

const WIDE = 16;
const LARGEST_ARRAY = 1 << 24; // bytes

/** Reads the body of a record, section by section. */
export class Sections {
  /** @param bytes Uint8Array */
  constructor(bytes, at = 0) {
    this.bytes = bytes;
    this.view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
    this.at = at;
  }

  take(count) {
    if (!(this.at + count <= this.bytes.length)) throw new FileError(`a record ends within the section at byte ${this.at}`);
    this.at += count;
    return this.at - count;
  }

  byte() {
    return this.bytes[this.take(1)];
  }

  word() {
    return this.view.getUint32(this.take(4), true);
  }

  double() {
    return this.view.getFloat64(this.take(8), true);
  }

  done() {
    if (this.at !== this.bytes.length) throw new FileError(`${this.bytes.length - this.at} bytes follow the last section`);
  }

  /** Decompresses a Zstandard frame of `length` bytes and checks that the result has `size` bytes. */
  inflated(length, size) {
    const at = this.take(length);
    let found;
    try {
      found = decompress(this.bytes.subarray(at, at + length), new Uint8Array(size));
    } catch (error) {
      throw new FileError(`zstandard: ${error.message}`);
    }
    if (found.length !== size) throw new FileError(`a section has ${found.length} bytes instead of ${size}`);
    return found;
  }

  sized(size) {
    return this.inflated(this.word(), size);
  }

  /** [count] signed integers. */
  plane(count) {
    const values = this.unsigned(count, 4);
    for (let i = 0; i < count; i++) values[i] = (values[i] >>> 1) ^ -(values[i] & 1);
    return values;
  }

  unsigned(count, wider) {
    const [mode, escapes, size] = [this.byte(), this.word(), this.word()];
    const values = new Int32Array(count);
    if (mode === 0) return values;
    if (![2, 4, 8, WIDE].includes(mode) || escapes > count || !wider) throw new FileError(`a plane of ${mode} bits is invalid`);
    if (mode === WIDE) {
      const low = this.inflated(size, count);
      const high = this.unsigned(count, wider - 1);
      for (let i = 0; i < count; i++) values[i] = low[i] | (high[i] << 8);
      return values;
    }
    const packed = (count * mode + 7) >> 3;
    const data = this.inflated(size, packed + 4 * escapes);
    const most = (1 << mode) - 1;
    if (mode === 8) for (let i = 0; i < count; i++) values[i] = data[i];
    else if (mode === 4) for (let i = 0; i < count; i++) values[i] = (data[i >> 1] >> ((i & 1) << 2)) & 15;
    else for (let i = 0; i < count; i++) values[i] = (data[i >> 2] >> ((i & 3) << 1)) & 3;
    if (!escapes) return values;
    const words = new DataView(data.buffer, data.byteOffset + packed);
    let next = 0;
    for (let i = 0; i < count; i++) {
      if (values[i] === most) values[i] = next < escapes ? words.getInt32(4 * next, true) : 0, next++;
    }
    if (next !== escapes) throw new FileError(`a plane has ${next} escapes instead of ${escapes}`);
    return values;
  }

  /** Residuals as [components] planes of [rows] integers; null if all are zero. */
  residuals(components, rows) {
    const kind = this.byte();
    if (kind === 0) return null;
    if (kind === 1) return Array.from({ length: components }, () => this.plane(rows));
    const chosen = this.marked(rows);
    return Array.from({ length: components }, () => {
      const some = this.plane(chosen.length);
      const all = new Int32Array(rows);
      for (let i = 0; i < chosen.length; i++) all[chosen[i]] = some[i];
      return all;
    });
  }

  /** Indices of the rows whose bit is set in a mask. */
  marked(rows) {
    const bits = this.sized((rows + 7) >> 3);
    const chosen = [];
    for (let i = 0; i < rows; i++) if ((bits[i >> 3] >> (7 - (i & 7))) & 1) chosen.push(i);
    return chosen;
  }

  /** [rows] Uint8Array of 0 and 1; null if the mask is unchanged. */
  mask(rows) {
    if (this.byte() === 0) return null;
    const mask = new Uint8Array(rows);
    for (const row of this.marked(rows)) mask[row] = 1;
    return mask;
  }

  /** { rows, values [width × rows] } of the exactly coded rows; null if there are none. */
  exact(most, width) {
    if (this.byte() === 0) return null;
    const count = this.word();
    if (!count || count > most) throw new FileError(`${count} exact rows of ${most} are invalid`);
    const data = this.sized(4 * count * (1 + width));
    const numbers = new DataView(data.buffer, data.byteOffset);
    const rows = Uint32Array.from({ length: count }, (_, i) => numbers.getUint32(4 * i, true));
    if (rows.some((row) => row >= most)) throw new FileError("an exact row is out of range");
    const values = Float32Array.from({ length: count * width }, (_, i) => numbers.getFloat32(4 * (count + i), true));
    return { rows, values };
  }

  /** Skips an array of floats. */
  skipArray() {
    if (this.byte() === 0) return;
    const dimensions = this.byte();
    let size = 4;
    for (let i = 0; i < dimensions; i++) size *= this.word();
    if (size > LARGEST_ARRAY) throw new FileError(`an array of ${size} bytes is too large`);
    this.take(this.word());
  }
}
