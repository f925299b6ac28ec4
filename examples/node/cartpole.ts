/**
 * CartPole: an agent pushes a cart left or right to balance a pole on it. Barto, Sutton & Anderson (1983), with the
 * constants, limits and rewards of gymnasium's CartPole-v1.
 */

import type { Spaces, Step, VectorEnvironment } from "./environment.ts";
import type { Choice, Components } from "./policy.ts";

export const OBSERVATION = "observation"; // the name of the only component of an observation
export const ACTION = "action"; // the name of the only component of an action
export const SPACES: Spaces = {
  observations: { [OBSERVATION]: { kind: "array", shape: [4], dtype: "float32", frames: 1 } },
  actions: { [ACTION]: { kind: "discrete", counts: [2], masked: false } },
};
export const SIZE = 4; // of an observation: position, velocity, angle, angular velocity

const GRAVITY = 9.8;
const POLE_MASS = 0.1;
const TOTAL_MASS = 1.0 + POLE_MASS;
const POLE_HALF_LENGTH = 0.5;
const FORCE = 10.0;
const STEP_SECONDS = 0.02;
const MAX_ANGLE = (12 * 2 * Math.PI) / 360; // 12 degrees, in radians
const MAX_POSITION = 2.4;
const MAX_STEPS = 500;

/** E environments with one component in observations and actions. */
export class VectorCartPole implements VectorEnvironment {
  readonly masks: Components = {};
  readonly count: number;
  readonly #random: () => number; // uniform in [0, 1)
  readonly #maxSteps: number; // of an episode
  readonly #state: Float64Array; // [E, 4]
  readonly #steps: Int32Array; // [E] taken in the running episode
  readonly #ended: Uint8Array; // [E] whether the last step ended the episode

  constructor(count: number, random: () => number, maxSteps = MAX_STEPS) {
    this.count = count;
    this.#random = random;
    this.#maxSteps = maxSteps;
    this.#state = new Float64Array(count * SIZE);
    this.#steps = new Int32Array(count);
    this.#ended = new Uint8Array(count);
    for (let e = 0; e < count; e++) this.#reset(e);
  }

  get observations(): Components {
    return { [OBSERVATION]: { dtype: "<f4", shape: [this.count, SIZE], data: Float32Array.from(this.#state) } };
  }

  /** Step every environment with its action: 1 pushes right, any other left. */
  step({ [ACTION]: actions }: Choice["actions"]): Step {
    const step = {
      rewards: new Float32Array(this.count),
      terminated: new Uint8Array(this.count),
      truncated: new Uint8Array(this.count),
    };
    for (let e = 0; e < this.count; e++) {
      if (this.#ended[e]) {
        this.#reset(e);
        continue;
      }
      this.#move(e, actions[e] === 1 ? FORCE : -FORCE);
      const [position, , angle] = this.#state.subarray(e * SIZE);
      step.rewards[e] = 1;
      step.terminated[e] = Number(Math.abs(position) > MAX_POSITION || Math.abs(angle) > MAX_ANGLE);
      step.truncated[e] = Number(++this.#steps[e] >= this.#maxSteps);
      this.#ended[e] = step.terminated[e] | step.truncated[e];
    }
    return step;
  }

  #reset(e: number): void {
    for (let i = 0; i < SIZE; i++) this.#state[e * SIZE + i] = 0.1 * this.#random() - 0.05;
    this.#steps[e] = 0;
    this.#ended[e] = 0;
  }

  /** Integrate the equations of motion over one step, by Euler's method. */
  #move(e: number, force: number): void {
    const state = this.#state.subarray(e * SIZE, (e + 1) * SIZE);
    const [position, velocity, angle, angularVelocity] = state;
    const [sine, cosine] = [Math.sin(angle), Math.cos(angle)];
    const push = (force + POLE_MASS * POLE_HALF_LENGTH * angularVelocity ** 2 * sine) / TOTAL_MASS;
    const angularAcceleration =
      (GRAVITY * sine - cosine * push) / (POLE_HALF_LENGTH * (4 / 3 - (POLE_MASS * cosine ** 2) / TOTAL_MASS));
    const acceleration = push - (POLE_MASS * POLE_HALF_LENGTH * angularAcceleration * cosine) / TOTAL_MASS;
    state.set([
      position + STEP_SECONDS * velocity,
      velocity + STEP_SECONDS * acceleration,
      angle + STEP_SECONDS * angularVelocity,
      angularVelocity + STEP_SECONDS * angularAcceleration,
    ]);
  }
}
