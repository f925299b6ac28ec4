/**
 * A task with nested observations and actions, as an example of such spaces. In Python the observation is
 * Dict(camera: Dict(image: Box), sensors: Dict(code: Discrete, level: Box)), the action Tuple(Discrete, Box,
 * MultiBinary). Each part of the action is learned from another part of the observation.
 */

import { type ContinuousSpace, type Spaces, type Step, unscaled, type VectorEnvironment } from "./environment.ts";
import type { Choice, Components } from "./policy.ts";

const LENGTH = 8; // steps of an episode; the largest return, too
const SIDE = 20; // pixels of the square image
const PLACES = 4; // vertical stripes of the image: one is bright
const CODES = 4;
const HEIGHT: ContinuousSpace = { kind: "continuous", low: [0], high: [2] };

/** Return the spaces. With masks one stripe, never the bright one, is an illegal choice. */
export function spaces(masked: boolean): Spaces {
  return {
    observations: {
      "camera.image": { kind: "array", shape: [SIDE, SIDE], dtype: "uint8", frames: 1 },
      "sensors.code": { kind: "discrete", counts: [CODES], masked: false },
      "sensors.level": { kind: "array", shape: [1], dtype: "float32", frames: 1 },
    },
    actions: {
      "0": { kind: "discrete", counts: [PLACES], masked },
      "1": HEIGHT,
      "2": { kind: "discrete", counts: [2, 2], masked: false },
    },
  };
}

/**
 * E environments. The reward of a step is the mean of three: 1 if the first part of the action is the bright stripe;
 * 1 - 2 d, at least 0, if d is the distance of the second part from the level plus 1; 1 if the third part has the two
 * bits of the code.
 */
export class VectorNested implements VectorEnvironment {
  readonly count: number;
  readonly #masked: boolean;
  readonly #random: () => number; // uniform in [0, 1)
  readonly #images: Uint8Array; // [E, SIDE, SIDE]
  readonly #codes: Uint8Array; // [E]
  readonly #levels: Float32Array; // [E]
  readonly #places: Uint8Array; // [E] bright stripe
  readonly #forbidden: Uint8Array; // [E] illegal stripe
  readonly #steps: Int32Array; // [E] taken in the running episode

  constructor(count: number, random: () => number, masked: boolean) {
    this.count = count;
    this.#masked = masked;
    this.#random = random;
    this.#images = new Uint8Array(count * SIDE * SIDE);
    this.#codes = new Uint8Array(count);
    this.#levels = new Float32Array(count);
    this.#places = new Uint8Array(count);
    this.#forbidden = new Uint8Array(count);
    this.#steps = new Int32Array(count);
    for (let e = 0; e < count; e++) this.#draw(e);
  }

  get observations(): Components {
    return {
      "camera.image": { dtype: "|u1", shape: [this.count, SIDE, SIDE], data: this.#images.slice() },
      "sensors.code": { dtype: "|u1", shape: [this.count, 1], data: this.#codes.slice() },
      "sensors.level": { dtype: "<f4", shape: [this.count, 1], data: this.#levels.slice() },
    };
  }

  get masks(): Components {
    if (!this.#masked) return {};
    const legal = new Uint8Array(this.count * PLACES).fill(1);
    for (let e = 0; e < this.count; e++) if (!this.#over(e)) legal[e * PLACES + this.#forbidden[e]] = 0;
    return { "0": { dtype: "|b1", shape: [this.count, PLACES], data: legal } };
  }

  step(actions: Choice["actions"]): Step {
    const step = {
      rewards: new Float32Array(this.count),
      terminated: new Uint8Array(this.count),
      truncated: new Uint8Array(this.count),
    };
    for (let e = 0; e < this.count; e++) {
      if (this.#over(e)) {
        this.#steps[e] = 0;
      } else {
        step.rewards[e] = this.#reward(e, actions["0"][e], actions["1"][e], actions["2"].slice(2 * e, 2 * e + 2));
        step.terminated[e] = Number(++this.#steps[e] === LENGTH);
      }
      this.#draw(e);
    }
    return step;
  }

  #over(e: number): boolean {
    return this.#steps[e] === LENGTH;
  }

  #reward(e: number, place: number, height: number, bits: ArrayLike<number>): number {
    if (this.#masked && place === this.#forbidden[e]) throw new Error(`the action ${place} is illegal here`);
    const distance = Math.abs(unscaled(HEIGHT, 0, height) - 1 - this.#levels[e]);
    const right = Number(place === this.#places[e]) + Number(bits[0] + 2 * bits[1] === this.#codes[e]);
    return (right + Math.max(0, 1 - 2 * distance)) / 3;
  }

  /** Draw what the next action must be. */
  #draw(e: number): void {
    this.#places[e] = this.#integer(PLACES);
    this.#codes[e] = this.#integer(CODES);
    this.#levels[e] = 2 * this.#random() - 1;
    this.#forbidden[e] = (this.#places[e] + 1 + this.#integer(PLACES - 1)) % PLACES;
    for (let pixel = 0; pixel < SIDE * SIDE; pixel++) {
      const stripe = Math.floor(((pixel % SIDE) * PLACES) / SIDE);
      this.#images[e * SIDE * SIDE + pixel] = this.#integer(64) + (stripe === this.#places[e] ? 128 : 0);
    }
  }

  #integer(count: number): number {
    return Math.floor(this.#random() * count);
  }
}
