/** Plays the policy in the environments and gathers rollouts. No connection. */

import { type CartPoles, SIZE } from "./cartpole.ts";
import type { Acting } from "./policy.ts";
import type { Message } from "./wire.ts";

/** What learning does to rewards and ends, from the run's specification. */
export interface Shaping {
  clip: number | null;
  scale: number;
  bootstrap_terminations: boolean; // a terminated episode counts as cut
}

export class Collector {
  readonly #environments: CartPoles;
  readonly #policy: Acting;
  readonly #shaping: Shaping;
  readonly #length: number; // T
  readonly #random: () => number;
  readonly #returns: Float64Array; // [E] of the running episodes
  readonly #lengths: Int32Array; // [E]
  #state: Float32Array<ArrayBufferLike>; // [E, S] the policy's memory
  #ended: Uint8Array; // [E] whether the last row ended an episode: the next one only resets

  constructor(environments: CartPoles, policy: Acting, shaping: Shaping, rolloutLength: number, random: () => number) {
    const count = environments.count;
    this.#environments = environments;
    this.#policy = policy;
    this.#shaping = shaping;
    this.#length = rolloutLength;
    this.#random = random;
    this.#returns = new Float64Array(count);
    this.#lengths = new Int32Array(count);
    this.#state = new Float32Array(count * policy.stateSize);
    this.#ended = new Uint8Array(count);
  }

  /** T rows more under the weights bound last, as a Rollout. */
  async collect(identity: Record<string, unknown>, policyVersion: unknown): Promise<Message> {
    const [rows, count] = [this.#length, this.#environments.count];
    const frames = new Float32Array((rows + 1) * count * SIZE); // [T+1, E, 4]; row T bootstraps
    const actions = new Uint8Array(rows * count); // this and all below [T, E]
    const logProbs = new Float32Array(rows * count);
    const rewards = new Float32Array(rows * count);
    const terminated = new Uint8Array(rows * count);
    const truncated = new Uint8Array(rows * count);
    const valid = new Uint8Array(rows * count);
    const finished: { returns: number[]; lengths: number[] } = { returns: [], lengths: [] };
    const initialState = this.#state.slice();
    frames.set(this.#environments.observations);
    for (let row = 0; row < rows; row++) {
      const at = row * count;
      const seen = frames.subarray(at * SIZE, (at + count) * SIZE);
      const acted = await this.#policy.act(seen, [SIZE], this.#state, this.#random);
      const step = this.#environments.step(acted.actions);
      valid.set(this.#ended.map((ended) => 1 - ended), at);
      this.#count(step.rewards, step.terminated, step.truncated, finished);
      frames.set(this.#environments.observations, (at + count) * SIZE);
      actions.set(acted.actions, at);
      logProbs.set(acted.logProbs, at);
      rewards.set(step.rewards.map((reward) => this.#shape(reward)), at);
      const { bootstrap_terminations } = this.#shaping; // then no end is a loss
      terminated.set(bootstrap_terminations ? new Uint8Array(count) : step.terminated, at);
      truncated.set(bootstrap_terminations ? this.#ended : step.truncated, at);
      // The row after one that only reset is the first of its episode: nothing before it is remembered.
      const size = this.#policy.stateSize;
      this.#state = acted.state.map((number, i) => number * valid[at + Math.floor(i / size)]);
    }
    const cells = [rows, count];
    return {
      kind: "Rollout",
      fields: { identity, policy_version: policyVersion },
      arrays: {
        frames: { dtype: "<f4", shape: [rows + 1, count, SIZE], data: frames },
        initial_state: { dtype: "<f4", shape: [count, this.#policy.stateSize], data: initialState },
        actions: { dtype: "|u1", shape: cells, data: actions },
        behaviour_log_probs: { dtype: "<f4", shape: cells, data: logProbs },
        rewards: { dtype: "<f4", shape: cells, data: rewards },
        terminated: { dtype: "|b1", shape: cells, data: terminated },
        truncated: { dtype: "|b1", shape: cells, data: truncated },
        valid: { dtype: "|b1", shape: cells, data: valid },
        episode_returns: { dtype: "<f4", shape: [finished.returns.length], data: Float32Array.from(finished.returns) },
        episode_lengths: { dtype: "<i4", shape: [finished.lengths.length], data: Int32Array.from(finished.lengths) },
      },
    };
  }

  /** Follows the running episodes; those that end in this row are appended to `finished`, with their true returns. */
  #count(
    rewards: Float32Array,
    terminated: Uint8Array,
    truncated: Uint8Array,
    finished: { returns: number[]; lengths: number[] },
  ): void {
    for (let e = 0; e < rewards.length; e++) {
      this.#returns[e] += rewards[e];
      this.#lengths[e] += 1 - this.#ended[e];
      this.#ended[e] = terminated[e] | truncated[e];
      if (!this.#ended[e]) continue;
      finished.returns.push(this.#returns[e]);
      finished.lengths.push(this.#lengths[e]);
      this.#returns[e] = this.#lengths[e] = 0;
    }
  }

  #shape(reward: number): number {
    const { clip, scale } = this.#shaping;
    return scale * (clip === null ? reward : Math.max(-clip, Math.min(clip, reward)));
  }
}
