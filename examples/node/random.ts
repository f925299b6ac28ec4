/**
 * Return a generator of uniform numbers in [0, 1): Marsaglia's 32-bit xorshift. The seed is mixed once, so that
 * neighbouring seeds give different sequences.
 */
export function seeded(seed: number): () => number {
  let state = Math.imul((seed >>> 0) ^ 0x9e3779b9, 0x85ebca6b) >>> 0 || 1;
  return () => {
    state ^= state << 13;
    state ^= state >>> 17;
    state ^= state << 5;
    state >>>= 0;
    return state / 2 ** 32;
  };
}

/** Return uniform float32 numbers from 0 to 1, 1 excluded: of 24 bits, as more would be rounded up to 1. */
export function uniform(count: number, random: () => number): Float32Array {
  return Float32Array.from({ length: count }, () => Math.floor(random() * 2 ** 24) / 2 ** 24);
}

/** Return standard normal float32 numbers, by the method of Box and Muller (1958). */
export function normal(count: number, random: () => number): Float32Array {
  return Float32Array.from({ length: count }, () => {
    const radius = Math.sqrt(-2 * Math.log(1 - random()));
    return radius * Math.cos(2 * Math.PI * random());
  });
}
