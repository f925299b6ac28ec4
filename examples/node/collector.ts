/** Rollouts from environments and a policy. No network. */

import { type DiscreteSpace, layout, type Spaces, type Step, type VectorEnvironment } from "./environment.ts";
import type { BehaviourPolicy, Choice } from "./policy.ts";
import { type Dtype, type Message, type WireArray, zeros } from "./wire.ts";

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
  readonly #environments: VectorEnvironment;
  readonly #spaces: Spaces;
  readonly #policy: BehaviourPolicy;
  readonly #settings: OutcomeSettings;
  readonly #rolloutLength: number; // T
  readonly #random: () => number; // uniform in [0, 1)
  readonly #returns: Float64Array; // [E] true returns of the running episodes
  readonly #lengths: Int32Array; // [E] valid rows of the running episodes
  #state: Float32Array<ArrayBufferLike>; // [E, S] state of the policy's memory
  #ended: Uint8Array; // [E] whether the last row ended an episode: the next row only resets

  constructor(
    environments: VectorEnvironment,
    spaces: Spaces,
    policy: BehaviourPolicy,
    settings: OutcomeSettings,
    rolloutLength: number,
    random: () => number,
  ) {
    const count = environments.count;
    this.#environments = environments;
    this.#spaces = spaces;
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
    const { frames, actions, masks } = componentRows(this.#spaces, rows, count);
    const [logProbs, rewards] = [new Rows("<f4", [rows, count]), new Rows("<f4", [rows, count])];
    const [terminated, truncated] = [new Rows("|b1", [rows, count]), new Rows("|b1", [rows, count])];
    const valid = new Rows("|b1", [rows, count]);
    const finished: FinishedEpisodes = { returns: [], lengths: [] };
    const initialState = this.#state.slice();
    frames.set(0, this.#environments.observations);
    for (let row = 0; row < rows; row++) {
      const { observations, masks: legal } = this.#environments;
      const acted = await this.#policy.act(observations, this.#state, legal, this.#random);
      masks.set(row, legal);
      const step = this.#environments.step(acted.actions);
      const isValid = this.#ended.map((ended) => 1 - ended);
      valid.set(row, isValid);
      this.#countEpisodes(step, finished);
      frames.set(row + 1, this.#environments.observations);
      actions.setValues(row, acted.actions);
      logProbs.set(row, acted.logProbs);
      rewards.set(row, step.rewards.map((reward) => this.#clipAndScale(reward)));
      const { bootstrap_terminations } = this.#settings;
      terminated.set(row, bootstrap_terminations ? new Uint8Array(count) : step.terminated);
      truncated.set(row, bootstrap_terminations ? this.#ended : step.truncated);
      // A row that only resets precedes the first row of an episode, which must begin with a zero state.
      const size = this.#policy.stateSize;
      this.#state = acted.state.map((number, i) => number * isValid[Math.floor(i / size)]);
    }
    return {
      kind: "Rollout",
      fields: { identity, policy_version: policyVersion },
      arrays: {
        ...frames.arrays("frames"),
        initial_state: { dtype: "<f4", shape: [count, this.#policy.stateSize], data: initialState },
        ...actions.arrays("actions"),
        ...masks.arrays("masks"),
        behaviour_log_probs: logProbs.array,
        rewards: rewards.array,
        terminated: terminated.array,
        truncated: truncated.array,
        valid: valid.array,
        episode_returns: { dtype: "<f4", shape: [finished.returns.length], data: Float32Array.from(finished.returns) },
        episode_lengths: { dtype: "<i4", shape: [finished.lengths.length], data: Int32Array.from(finished.lengths) },
      },
    };
  }

  /** Count one row of unscaled rewards in the running episodes. Append the episodes that end in it to `finished`. */
  #countEpisodes({ rewards, terminated, truncated }: Step, finished: FinishedEpisodes): void {
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

/** Values of several rows [rows, E, *shape]. */
class Rows {
  readonly array: WireArray;
  readonly #size: number; // of one row

  constructor(dtype: Dtype, shape: number[]) {
    this.array = zeros(dtype, shape);
    this.#size = shape.slice(1).reduce((product, side) => product * side, 1);
  }

  set(row: number, values: ArrayLike<number>): void {
    (this.array.data as Uint8Array).set(values, row * this.#size);
  }
}

/** Values of several rows of all components of a kind. */
class ComponentRows {
  readonly #rows: Record<string, Rows>;

  constructor(rows: Record<string, Rows>) {
    this.#rows = rows;
  }

  set(row: number, components: Record<string, WireArray>): void {
    for (const [name, rows] of Object.entries(this.#rows)) rows.set(row, components[name].data as Uint8Array);
  }

  setValues(row: number, values: Choice["actions"]): void {
    for (const [name, rows] of Object.entries(this.#rows)) rows.set(row, values[name]);
  }

  /** Return the arrays of a message, named `kind`/NAME. */
  arrays(kind: string): Record<string, WireArray> {
    return Object.fromEntries(Object.entries(this.#rows).map(([name, { array }]) => [`${kind}/${name}`, array]));
  }
}

/** Return the rows of frames, of which the last bootstraps, of actions and of masks. */
function componentRows({ observations, actions }: Spaces, rows: number, count: number): Record<string, ComponentRows> {
  const component = (rows: number, space: Parameters<typeof layout>[0]) => {
    const { dtype, shape } = layout(space);
    return new Rows(dtype, [rows, count, ...shape]);
  };
  const choices = ({ counts }: DiscreteSpace) => counts.reduce((sum, each) => sum + each, 0);
  const each = <S>(spaces: Record<string, S>, make: (space: S) => Rows | undefined): ComponentRows => {
    const made = Object.entries(spaces).flatMap(([name, space]) => {
      const rows = make(space);
      return rows ? [[name, rows] as const] : [];
    });
    return new ComponentRows(Object.fromEntries(made));
  };
  return {
    frames: each(observations, (space) => component(rows + 1, space)),
    actions: each(actions, (space) => component(rows, space)),
    masks: each(actions, (space) =>
      space.kind === "discrete" && space.masked ? new Rows("|b1", [rows, count, choices(space)]) : undefined,
    ),
  };
}
