/**
 * Messages to bytes and back, as docs/wire.md has them. This file knows no key, no connection and no state.
 *
 * Numbers above 2^32 are bigints on both ways, so that identities come back as they went.
 */

import { decode as unpack, encode as pack } from "@msgpack/msgpack";
import { constants, zstdCompressSync, zstdDecompressSync } from "node:zlib";

export const PROTOCOL_VERSION = 5;
export const MAX_BODY_BYTES = 2 ** 30; // of what the learner sends: weights may be large

const MAGIC = 0x44454144; // "DAED" as a little-endian number
const PREFIX_BYTES = 12;
const MAX_HEADER_BYTES = 256 * 1024;
const MAX_ARRAYS = 4096;
const MAX_DIMENSIONS = 8;
const PLAIN = 0;
const ZSTD = 1;
const COMPRESSED = new Set(["Rollout", "Program", "CompactSnapshot"]);

const TYPES = {
  "<f4": Float32Array,
  "|u1": Uint8Array,
  "|b1": Uint8Array,
  "<u2": Uint16Array,
  "<i4": Int32Array,
  "<i8": BigInt64Array,
};
export type Dtype = keyof typeof TYPES;
type Data = Float32Array | Uint8Array | Uint16Array | Int32Array | BigInt64Array;

/** An array with its shape; of a swapped one, the second axis comes first in `data`. */
export interface WireArray {
  dtype: Dtype;
  shape: number[];
  swapped?: boolean;
  data: Data;
}

export interface Message {
  kind: string;
  fields: Record<string, unknown>;
  arrays: Record<string, WireArray>;
}

/** The bytes are no message that this end can accept. */
export class ProtocolError extends Error {}

/** The other end speaks another version of the protocol. */
export class VersionMismatchError extends ProtocolError {}

/** The bytes of a message. */
export function encode(message: Message): Buffer {
  const arrays = Object.entries(message.arrays);
  let body = Buffer.concat(
    arrays.flatMap(([, { data }]) => [
      Buffer.from(data.buffer, data.byteOffset, data.byteLength),
      Buffer.alloc(padding(data.byteLength)),
    ]),
  );
  const header = pack(
    {
      kind: message.kind,
      fields: message.fields,
      arrays: arrays.map(([name, array]) => [name, array.dtype, array.shape, array.swapped ?? false]),
      size: body.length,
    },
    { useBigInt64: true },
  );
  let flags = PLAIN;
  if (COMPRESSED.has(message.kind) && body.length > 0) {
    const smaller = zstdCompressSync(body, {
      pledgedSrcSize: body.length, // a frame has to declare its size
      params: { [constants.ZSTD_c_compressionLevel]: 1 },
    });
    if (smaller.length < body.length) [flags, body] = [ZSTD, smaller];
  }
  const prefix = Buffer.alloc(PREFIX_BYTES);
  prefix.writeUInt32LE(MAGIC, 0);
  prefix.writeUInt16LE(PROTOCOL_VERSION, 4);
  prefix.writeUInt16LE(flags, 6);
  prefix.writeUInt32LE(header.length, 8);
  return Buffer.concat([prefix, header, Buffer.alloc(padding(PREFIX_BYTES + header.length)), body]);
}

/** The message in `bytes`; throws ProtocolError if it is anything but one whole message. */
export function decode(bytes: Uint8Array, maxBodyBytes = MAX_BODY_BYTES): Message {
  const view = Buffer.from(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  if (view.length < PREFIX_BYTES || view.readUInt32LE(0) !== MAGIC) throw new ProtocolError("not a message");
  const version = view.readUInt16LE(4);
  if (version !== PROTOCOL_VERSION) {
    throw new VersionMismatchError(`the other end speaks protocol version ${version}, this one ${PROTOCOL_VERSION}`);
  }
  const flags = view.readUInt16LE(6);
  const headerBytes = view.readUInt32LE(8);
  const end = PREFIX_BYTES + headerBytes;
  const bodyStart = end + padding(end);
  if (headerBytes > MAX_HEADER_BYTES || bodyStart > view.length) throw new ProtocolError("its header is too long");
  const { kind, fields, arrays, size } = readHeader(view.subarray(PREFIX_BYTES, end));
  if (size > maxBodyBytes) throw new ProtocolError(`a body of ${size} bytes, the limit is ${maxBodyBytes}`);
  const body = readBody(flags, kind, view.subarray(bodyStart), size);
  const message: Message = { kind, fields, arrays: {} };
  let offset = 0;
  for (const [name, dtype, shape, swapped] of arrays) {
    const type = TYPES[dtype];
    const length = shape.reduce((product, side) => product * side, 1);
    const byteLength = length * type.BYTES_PER_ELEMENT;
    if (offset + byteLength > size || Object.hasOwn(message.arrays, name)) throw new ProtocolError(`array ${name} does not fit`);
    message.arrays[name] = { dtype, shape, swapped, data: new type(body, offset, length) };
    offset += byteLength + padding(byteLength);
  }
  if (offset !== size) throw new ProtocolError(`the arrays take ${offset} bytes, the body has ${size}`);
  return message;
}

/** The message in `bytes`; nothing if it is damaged. Throws VersionMismatchError if another version wrote it. */
export function decodeWhole(bytes: Uint8Array): Message | undefined {
  try {
    return decode(bytes);
  } catch (error) {
    if (error instanceof VersionMismatchError || !(error instanceof ProtocolError)) throw error;
  }
}

type Entry = [name: string, dtype: Dtype, shape: number[], swapped: boolean];

function readHeader(bytes: Uint8Array): { kind: string; fields: Message["fields"]; arrays: Entry[]; size: number } {
  let content: any;
  try {
    content = unpack(bytes, { useBigInt64: true, maxBinLength: 0, maxExtLength: 0 });
  } catch (error) {
    throw new ProtocolError(`unreadable header: ${error}`);
  }
  const { kind, fields, arrays, size } = content ?? {};
  const whole = (value: unknown) => Number.isSafeInteger(value) && (value as number) >= 0;
  const isEntry = (entry: any) =>
    Array.isArray(entry) &&
    entry.length === 4 &&
    typeof entry[0] === "string" &&
    Object.hasOwn(TYPES, entry[1]) &&
    Array.isArray(entry[2]) &&
    entry[2].length <= MAX_DIMENSIONS &&
    entry[2].every(whole) &&
    typeof entry[3] === "boolean";
  if (typeof kind !== "string" || typeof fields !== "object" || fields === null || !whole(size)) {
    throw new ProtocolError("the header lacks kind, fields or size");
  }
  if (!Array.isArray(arrays) || arrays.length > MAX_ARRAYS || !arrays.every(isEntry)) {
    throw new ProtocolError("the header's arrays are not as they should be");
  }
  return { kind, fields, arrays, size };
}

/** The plain body in memory of its own, at whose start every array's type may begin. */
function readBody(flags: number, kind: string, body: Buffer, size: number): ArrayBuffer {
  let plain: Uint8Array = body;
  if (flags === ZSTD && COMPRESSED.has(kind)) {
    try {
      plain = zstdDecompressSync(body, { maxOutputLength: Math.max(size, 1) });
    } catch (error) {
      throw new ProtocolError(`unreadable body: ${error}`);
    }
  } else if (flags !== PLAIN) {
    throw new ProtocolError(`a ${kind} with flags ${flags}`);
  }
  if (plain.length !== size) throw new ProtocolError(`a body of ${plain.length} bytes that declares ${size}`);
  return new Uint8Array(plain).buffer;
}

function padding(length: number): number {
  return -length & 7;
}
