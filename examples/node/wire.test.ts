/** Tests of the encoding with the golden messages, which the Python tests use too. */

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { test } from "node:test";
import { zstdDecompressSync } from "node:zlib";
import { decode, encode, PROTOCOL_VERSION, ProtocolError, type WireArray } from "./wire.ts";

const FOLDER = new URL(`../../tests/protocol/golden/v${PROTOCOL_VERSION}/`, import.meta.url);
const bytesOf = (name: string) => readFileSync(new URL(`${name}.bin`, FOLDER));

/** Reviver for JSON.parse: return integers from 2^32 as bigints, as `decode` does. */
function reviveIntegers(_key: string, value: unknown, context?: { source?: string }): unknown {
  const whole = typeof value === "number" && /^\d+$/.test(context?.source ?? "");
  return whole && (value as number) >= 2 ** 32 ? BigInt(context!.source!) : value;
}

const VALUES: Record<string, any> = JSON.parse(readFileSync(new URL("values.json", FOLDER), "utf8"), reviveIntegers);

/** Return the values of an array in the order of its shape. */
function inOrder({ shape, swapped, data }: WireArray): unknown[] {
  if (!swapped) return Array.from(data as ArrayLike<unknown>);
  const [first, second, ...rest] = shape;
  const size = rest.reduce((product, side) => product * side, 1);
  const rows = Array.from({ length: first * second }, (_, i) => {
    const at = ((i % second) * first + Math.floor(i / second)) * size; // the second axis is stored first
    return Array.from((data as Uint8Array).subarray(at, at + size));
  });
  return rows.flat();
}

/** Return a message with its body decompressed: zstd's output may differ between releases. */
function plain(bytes: Buffer): Buffer {
  const end = 12 + bytes.readUInt32LE(8);
  const start = end + (-end & 7);
  const body = bytes.subarray(start);
  return Buffer.concat([bytes.subarray(0, start), bytes.readUInt16LE(6) === 1 ? zstdDecompressSync(body) : body]);
}

test("golden messages of this protocol version exist", () => {
  assert.ok(Object.keys(VALUES).length >= 10);
});

for (const [name, { kind, fields, arrays }] of Object.entries(VALUES)) {
  test(`${name} decodes to its recorded values`, () => {
    const message = decode(bytesOf(name));
    assert.equal(message.kind, kind);
    assert.deepEqual(message.fields, fields);
    assert.deepEqual(Object.keys(message.arrays), Object.keys(arrays));
    for (const [arrayName, array] of Object.entries(message.arrays)) {
      const { dtype, shape, values } = arrays[arrayName];
      assert.deepEqual([array.dtype, array.shape], [dtype, shape]);
      assert.deepEqual(inOrder(array).map(Number), values.map(Number));
    }
  });

  test(`${name} is encoded to the same bytes`, () => {
    const message = decode(bytesOf(name));
    // JavaScript does not distinguish 50.0 from 50: the bytes of messages with such numbers may differ.
    if (["Welcome", "StatusReport", "ActorsReport"].includes(kind)) assert.deepEqual(decode(encode(message)), message);
    else assert.deepEqual(plain(encode(message)), plain(bytesOf(name)));
  });
}

test("differences of a compact snapshot are added as docs/wire.md specifies", () => {
  const { arrays } = decode(bytesOf("compact_snapshot"));
  const added = (name: string, base: (i: number) => number) => {
    const planes = arrays[`weights/${name}`].data as Uint8Array;
    const count = planes.length / 2;
    return Array.from({ length: count }, (_, i) => {
      const folded = (planes[i] << 8) | planes[count + i];
      const bits = (new Uint32Array(Float32Array.of(base(i)).buffer)[0] >>> 16) + ((folded >> 1) ^ -(folded & 1));
      return new Float32Array(Uint32Array.of((bits & 0xffff) << 16).buffer)[0];
    });
  };
  // The weights change from the 3 x 3 identity to 1.01 times it (1.0078125 in bfloat16), the biases from 1 to 0.
  const diagonal = (i: number) => Number(i % 4 === 0);
  assert.deepEqual(added("body.weight", diagonal), Array.from({ length: 9 }, (_, i) => 1.0078125 * diagonal(i)));
  assert.deepEqual(added("body.bias", () => 1), [0, 0, 0]);
});

test("damaged bytes raise ProtocolError and nothing else", () => {
  for (const name of Object.keys(VALUES)) {
    const whole = bytesOf(name);
    for (let length = 0; length < whole.length; length += 1 + (length >> 5)) {
      assert.throws(() => decode(whole.subarray(0, length)), ProtocolError, `${name} cut to ${length} bytes`);
    }
    for (let at = 0; at < whole.length; at++) {
      const damaged = Buffer.from(whole);
      damaged[at] ^= 0x55;
      try {
        decode(damaged);
      } catch (error) {
        assert.ok(error instanceof ProtocolError, `${name} damaged at ${at}: ${error}`);
      }
    }
  }
});

test("a message of another protocol version is reported with its version", () => {
  const other = bytesOf("join");
  other.writeUInt16LE(PROTOCOL_VERSION + 1, 4);
  assert.throws(() => decode(other), /uses protocol version/);
});

test("a body larger than the limit is refused", () => {
  assert.throws(() => decode(bytesOf("program"), 100), /the limit is 100/);
});
