/** Rollouts from environments and a policy. No network. */

import { ACTION, OBSERVATION, SIZE, type VectorCartPole } from "./cartpole.ts";
import type { BehaviourPolicy } from "./policy.ts";
import type { Message, WireArray } from "./wire.ts";

/** How a rollout records rewards and ends of episodes for training, from the run's specification. */
export interface OutcomeSettings {
  reward_clip: number | null; // clip rewards to +- this value; null: do not clip
  reward_scale: number; // multiply the clipped rewards by this value
  bootstrap_terminations: boolean; // mark terminated rows as truncated
}

/** Returns and lengths of episodes that ended, in the same order. */
interface FinishedEpisodes {
  returns: number[];
  lengths: number[];
}

/** The state that E environments carry from rollout to rollout. */
export class Collector {
  readonly #environments: VectorCartPole;
  readonly #policy: BehaviourPolicy;
  readonly #settings: OutcomeSettings;
  readonly #rolloutLength: number; // T
  readonly #random: () => number; // uniform in [0, 1)
  readonly #returns: Float64Array; // [E] true returns of the running episodes
  readonly #lengths: Int32Array; // [E] valid rows of the running episodes
  #state: Float32Array<ArrayBufferLike>; // [E, S] state of the policy's memory
  #ended: Uint8Array; // [E] whether the last row ended an episode: the next row only resets

  constructor(
    environments: VectorCartPole,
    policy: BehaviourPolicy,
    settings: OutcomeSettings,
    rolloutLength: number,
    random: () => number,
  ) {
    const count = environments.count;
    this.#environments = environments;
    this.#policy = policy;
    this.#settings = settings;
    this.#rolloutLength = rolloutLength;
    this.#random = random;
    this.#returns = new Float64Array(count);
    this.#lengths = new Int32Array(count);
    this.#state = new Float32Array(count * policy.stateSize);
    this.#ended = new Uint8Array(count);
  }

  /** Collect the next T rows under the weights that the policy holds, and return them as a Rollout message. */
  async collect(identity: Record<string, unknown>, policyVersion: unknown): Promise<Message> {
    const [rows, count] = [this.#rolloutLength, this.#environments.count];
    const frames = new Float32Array((rows + 1) * count * SIZE); // [T+1, E, 4]; row T bootstraps
    const actions = new Uint8Array(rows * count); // [T, E, 1]; the next five [T, E]
    const logProbs = new Float32Array(rows * count);
    const rewards = new Float32Array(rows * count);
    const terminated = new Uint8Array(rows * count);
    const truncated = new Uint8Array(rows * count);
    const valid = new Uint8Array(rows * count);
    const finished: FinishedEpisodes = { returns: [], lengths: [] };
    const initialState = this.#state.slice();
    frames.set(this.#environments.observations);
    for (let row = 0; row < rows; row++) {
      const start = row * count;
      const data = frames.subarray(start * SIZE, (start + count) * SIZE);
      const observed: WireArray = { dtype: "<f4", shape: [count, SIZE], data };
      const acted = await this.#policy.act({ [OBSERVATION]: observed }, this.#state, {}, this.#random);
      const step = this.#environments.step(acted.actions[ACTION]);
      valid.set(this.#ended.map((ended) => 1 - ended), start);
      this.#countEpisodes(step.rewards, step.terminated, step.truncated, finished);
      frames.set(this.#environments.observations, (start + count) * SIZE);
      actions.set(acted.actions[ACTION], start);
      logProbs.set(acted.logProbs, start);
      rewards.set(step.rewards.map((reward) => this.#clipAndScale(reward)), start);
      const { bootstrap_terminations } = this.#settings;
      terminated.set(bootstrap_terminations ? new Uint8Array(count) : step.terminated, start);
      truncated.set(bootstrap_terminations ? this.#ended : step.truncated, start);
      // A row that only resets precedes the first row of an episode, which must begin with a zero state.
      const size = this.#policy.stateSize;
      this.#state = acted.state.map((number, i) => number * valid[start + Math.floor(i / size)]);
    }
    const shape = [rows, count];
    return {
      kind: "Rollout",
      fields: { identity, policy_version: policyVersion },
      arrays: {
        [`frames/${OBSERVATION}`]: { dtype: "<f4", shape: [rows + 1, count, SIZE], data: frames },
        initial_state: { dtype: "<f4", shape: [count, this.#policy.stateSize], data: initialState },
        [`actions/${ACTION}`]: { dtype: "|u1", shape: [rows, count, 1], data: actions },
        behaviour_log_probs: { dtype: "<f4", shape, data: logProbs },
        rewards: { dtype: "<f4", shape, data: rewards },
        terminated: { dtype: "|b1", shape, data: terminated },
        truncated: { dtype: "|b1", shape, data: truncated },
        valid: { dtype: "|b1", shape, data: valid },
        episode_returns: { dtype: "<f4", shape: [finished.returns.length], data: Float32Array.from(finished.returns) },
        episode_lengths: { dtype: "<i4", shape: [finished.lengths.length], data: Int32Array.from(finished.lengths) },
      },
    };
  }

  /** Count one row of unscaled rewards in the running episodes. Append the episodes that end in it to `finished`. */
  #countEpisodes(
    rewards: Float32Array,
    terminated: Uint8Array,
    truncated: Uint8Array,
    finished: FinishedEpisodes,
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

  #clipAndScale(reward: number): number {
    const { reward_clip, reward_scale } = this.#settings;
    return reward_scale * (reward_clip === null ? reward : Math.max(-reward_clip, Math.min(reward_clip, reward)));
  }
}
