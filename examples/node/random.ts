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
