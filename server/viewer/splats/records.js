// Records of a compact 4D file (docs/format.md): heads and bodies with checksums, and the head of the file.

const MAGIC = 0x52643473; // "s4dR", little-endian
export const HEAD_SIZE = 36;
const VERSION = 1;
export const HEAD = 1;
export const BORN = 2;
export const KEY = 3;
export const DELTA = 4;
export const PARTS = 5;
export const INDEX = 6;
const NOTE = 7; // information about a frame; skipped

/** Error for a file that cannot be read, or only up to some position; the message is human-readable. */
export class FileError extends Error {}

const TABLE = new Int32Array(256).map((_, i) => {
  for (let k = 0; k < 8; k++) i = i & 1 ? (i >>> 1) ^ 0xedb88320 : i >>> 1;
  return i;
});

/** CRC-32 of bytes as an unsigned integer. */
export function crc32(bytes) {
  let crc = -1;
  for (let i = 0; i < bytes.length; i++) crc = TABLE[(crc ^ bytes[i]) & 255] ^ (crc >>> 8);
  return ~crc >>> 0;
}

/**
 * Lists the complete records of a file; an incomplete record at the end is ignored.
 *
 * @param bytes Uint8Array  @param from offset of the first record to list
 * @returns { records, damage }: records { kind, frame, time, offset, size, checksum }, and the damage after them, or null
 */
export function list(bytes, from = 0) {
  const records = [];
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  for (let at = from; at + HEAD_SIZE <= bytes.length;) {
    const kind = bytes[at + 4];
    if (view.getUint32(at, true) !== MAGIC || view.getUint32(at + 32, true) !== crc32(bytes.subarray(at, at + 32))) {
      return { records, damage: `the file is damaged at byte ${at}, where a record should start` };
    }
    if (kind < HEAD || kind > NOTE) return { records, damage: `the record at byte ${at} has the unknown kind ${kind}; it was written by a later version of scas4d` };
    const record = { kind, frame: Number(view.getBigInt64(at + 8, true)), time: view.getFloat64(at + 16, true),
      offset: at + HEAD_SIZE, size: view.getUint32(at + 24, true), checksum: view.getUint32(at + 28, true) };
    at = record.offset + record.size;
    if (at > bytes.length) break;
    records.push(record);
    if (kind === INDEX) break;
  }
  return { records, damage: null };
}

/** Body of a record, after verifying its checksum. */
export function bodyOf(bytes, record) {
  const body = bytes.subarray(record.offset, record.offset + record.size);
  if (crc32(body) !== record.checksum) {
    throw new FileError(`the record of frame ${record.frame} at byte ${record.offset - HEAD_SIZE} is damaged`);
  }
  return body;
}

/** Head of the file, with world, bounds, background and cameras; checks the numbers on which everything else depends. */
export function readHead(bytes, record) {
  let head = null;
  if (record?.kind === HEAD) {
    try {
      head = JSON.parse(new TextDecoder().decode(bodyOf(bytes, record)));
    } catch {
      head = null;
    }
  }
  if (head?.format !== "scas4d") throw new FileError("this is not a compact 4D file, or its head is damaged or truncated");
  if (head.version > VERSION) {
    throw new FileError(`the file has format version ${head.version}, but this player reads only up to ${VERSION}; use a later one`);
  }
  const numbers = [...head.world.origin, head.world.metres_per_unit, ...head.background];
  if (numbers.length !== 7 || !numbers.every(Number.isFinite) || !(head.world.metres_per_unit > 0)) {
    throw new FileError("the head of the file is incomplete or invalid");
  }
  return head;
}
