/**
 * The encoding of messages as bytes, specified in docs/wire.md. Pure functions.
 *
 * Integers from 2^32 are bigints, in decoded messages and in those to encode: a number of JavaScript, a double, cannot
 * hold every learner epoch and incarnation.
 */

import { decode as unpack, encode as pack } from "@msgpack/msgpack";
import { constants, zstdCompressSync, zstdDecompressSync } from "node:zlib";

export const PROTOCOL_VERSION = 11;
export const MAX_BODY_BYTES = 2 ** 30; // of messages from the learner: weights may be large

const MAGIC = 0x44454144; // "DAED" as a little-endian number
const PREFIX_BYTES = 12;
const MAX_HEADER_BYTES = 256 * 1024;
const MAX_ARRAYS = 4096;
const MAX_DIMENSIONS = 8;
const PLAIN = 0; // flags of a message
const ZSTD = 1;
const COMPRESSED_KINDS = new Set(["Rollout", "Gradient", "Program", "CompactSnapshot"]);

const TYPES = {
  "<f4": Float32Array,
  "|u1": Uint8Array,
  "|b1": Uint8Array,
  "<u2": Uint16Array,
  "<i4": Int32Array,
  "<i8": BigInt64Array,
  "<f8": Float64Array,
};
export type Dtype = keyof typeof TYPES;
type Data = Float32Array | Uint8Array | Uint16Array | Int32Array | BigInt64Array | Float64Array;

/** An array of a message. If it is swapped, `data` has the second axis first. */
export interface WireArray {
  dtype: Dtype;
  shape: number[];
  swapped?: boolean;
  data: Data;
}

/** A message: its kind, its fields that are not arrays, and its arrays, all by the names in docs/wire.md. */
export interface Message {
  kind: string;
  fields: Record<string, unknown>;
  arrays: Record<string, WireArray>;
}

/** The bytes are not an acceptable message: a fault of the sender. */
export class ProtocolError extends Error {}

/** The other end uses another version of the protocol. */
export class VersionMismatchError extends ProtocolError {}

/** Return an array of zeros. */
export function zeros(dtype: Dtype, shape: number[]): WireArray {
  return { dtype, shape, data: new TYPES[dtype](shape.reduce((product, side) => product * side, 1)) };
}

/** Encode a message. */
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
  if (COMPRESSED_KINDS.has(message.kind) && body.length > 0) {
    const smaller = zstdCompressSync(body, {
      pledgedSrcSize: body.length, // the frame must declare its content size
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

/** Decode a message. Throws ProtocolError unless `bytes` are exactly one complete message within the limits. */
export function decode(bytes: Uint8Array, maxBodyBytes = MAX_BODY_BYTES): Message {
  const view = Buffer.from(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  if (view.length < PREFIX_BYTES || view.readUInt32LE(0) !== MAGIC) {
    throw new ProtocolError("not a message of this protocol");
  }
  const version = view.readUInt16LE(4);
  if (version !== PROTOCOL_VERSION) {
    throw new VersionMismatchError(
      `the other end uses protocol version ${version}, this one ${PROTOCOL_VERSION}: install the same release on both`,
    );
  }
  const flags = view.readUInt16LE(6);
  const headerBytes = view.readUInt32LE(8);
  const end = PREFIX_BYTES + headerBytes;
  const bodyStart = end + padding(end);
  if (headerBytes > MAX_HEADER_BYTES || bodyStart > view.length) {
    throw new ProtocolError(
      `a header of ${headerBytes} bytes in a message of ${view.length}, the limit is ${MAX_HEADER_BYTES}`,
    );
  }
  const { kind, fields, arrays, size } = readHeader(view.subarray(PREFIX_BYTES, end));
  if (size > maxBodyBytes) throw new ProtocolError(`the body declares ${size} bytes, the limit is ${maxBodyBytes}`);
  const body = readBody(flags, kind, view.subarray(bodyStart), size);
  const message: Message = { kind, fields, arrays: {} };
  let offset = 0;
  for (const [name, dtype, shape, swapped] of arrays) {
    const type = TYPES[dtype];
    const length = shape.reduce((product, side) => product * side, 1);
    const byteLength = length * type.BYTES_PER_ELEMENT;
    if (offset + byteLength > size || Object.hasOwn(message.arrays, name)) {
      throw new ProtocolError(`array '${name}' is a duplicate, or exceeds the body of ${size} bytes`);
    }
    message.arrays[name] = { dtype, shape, swapped, data: new type(body, offset, length) };
    offset += byteLength + padding(byteLength);
  }
  if (offset !== size) throw new ProtocolError(`the arrays take ${offset} bytes, the body declares ${size}`);
  return message;
}

/** Decode a message; return undefined if it is damaged. Throws VersionMismatchError if another version wrote it. */
export function tryDecode(bytes: Uint8Array): Message | undefined {
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
  const isLength = (value: unknown) => Number.isSafeInteger(value) && (value as number) >= 0;
  const isEntry = (entry: any) =>
    Array.isArray(entry) &&
    entry.length === 4 &&
    typeof entry[0] === "string" &&
    Object.hasOwn(TYPES, entry[1]) &&
    Array.isArray(entry[2]) &&
    entry[2].length <= MAX_DIMENSIONS &&
    entry[2].every(isLength) &&
    typeof entry[3] === "boolean";
  if (typeof kind !== "string" || typeof fields !== "object" || fields === null || !isLength(size)) {
    throw new ProtocolError("the header's kind, fields or size are missing or have the wrong type");
  }
  if (!Array.isArray(arrays) || arrays.length > MAX_ARRAYS || !arrays.every(isEntry)) {
    throw new ProtocolError(`the header must list up to ${MAX_ARRAYS} arrays by name, dtype, shape and swapped`);
  }
  return { kind, fields, arrays, size };
}

/** Return the plain body in a buffer of its own, so that its arrays are aligned. Throws ProtocolError. */
function readBody(flags: number, kind: string, body: Buffer, size: number): ArrayBuffer {
  let plain: Uint8Array = body;
  if (flags === ZSTD && COMPRESSED_KINDS.has(kind)) {
    try {
      plain = zstdDecompressSync(body, { maxOutputLength: Math.max(size, 1) });
    } catch (error) {
      throw new ProtocolError(`unreadable body: ${error}`);
    }
  } else if (flags !== PLAIN) {
    throw new ProtocolError(`a ${kind} must not have flags ${flags}`);
  }
  if (plain.length !== size) throw new ProtocolError(`the body has ${plain.length} bytes, it declares ${size}`);
  return new Uint8Array(plain).buffer;
}

/** Return the number of zeros after `length` bytes, up to a multiple of 8. */
function padding(length: number): number {
  return -length & 7;
}
