/** Runs the learner's ONNX program with the weights of a snapshot. This file knows no connection and no environment. */

import { createHash } from "node:crypto";
import { InferenceSession, Tensor } from "onnxruntime-node";
import type { WireArray } from "./wire.ts";

/** A program or weights that do not fit together, or not the environment. */
export class PolicyError extends Error {}

export interface Acted {
  actions: Uint8Array; // [E]
  logProbs: Float32Array; // [E]
  state: Float32Array; // [E, S] the policy's memory for the next row
}

/** What the collector needs of a policy. */
export interface Acting {
  readonly stateSize: number; // S, how many numbers it remembers from row to row; 0 for most

  /** One sampled action for each of the observations [E, ...shape] under the memory `state` [E, S]. */
  act(observations: Float32Array, shape: number[], state: Float32Array, random: () => number): Promise<Acted>;
}

export class Policy implements Acting {
  readonly stateSize: number;
  readonly #session: InferenceSession;
  readonly #wanted: Map<string, readonly (number | string)[]>; // the shapes of its weights, by name
  #weights: Record<string, Tensor> = {};

  /** The policy of a program, `name` being the hash that it must have. */
  static async load(model: Uint8Array, name: string): Promise<Policy> {
    if (createHash("sha256").update(model).digest("hex") !== name) throw new PolicyError("not the program asked for");
    const session = await InferenceSession.create(model, {
      intraOpNumThreads: 1,
      interOpNumThreads: 1,
      // A model may name files to take weights from. None lie here: whoever sends a program shall not read with it.
      extra: { session: { model_external_initializers_file_folder_path: "/dev/null" } },
    });
    return new Policy(session);
  }

  private constructor(session: InferenceSession) {
    this.#session = session;
    this.#wanted = new Map();
    let stateSize = 0;
    for (const input of session.inputMetadata) {
      if (!input.isTensor || input.type !== "float32") throw new PolicyError(`input ${input.name} is no float tensor`);
      if (input.name === "state") stateSize = Number(input.shape[1]);
      else if (input.name !== "observations") this.#wanted.set(input.name, input.shape);
    }
    if (!session.inputNames.includes("observations") || session.outputNames[0] !== "logits") {
      throw new PolicyError("the program does not turn observations into logits");
    }
    this.stateSize = stateSize;
  }

  /** Binds a snapshot's weights, by name, for all later calls. */
  bind(weights: Record<string, WireArray>): void {
    const bound: Record<string, Tensor> = {};
    for (const [name, shape] of this.#wanted) {
      const given = weights[name];
      if (given?.dtype !== "<f4" || String(given.shape) !== String(shape)) {
        throw new PolicyError(`the snapshot has no weights ${name} [${shape}]`);
      }
      bound[name] = new Tensor("float32", given.data as Float32Array, given.shape);
    }
    this.#weights = bound;
  }

  async act(observations: Float32Array, shape: number[], state: Float32Array, random: () => number): Promise<Acted> {
    const rows = observations.length / shape.reduce((product, side) => product * side, 1);
    const feeds: Record<string, Tensor> = {
      ...this.#weights,
      observations: new Tensor("float32", observations, [rows, ...shape]),
    };
    if (this.stateSize) feeds.state = new Tensor("float32", state, [rows, this.stateSize]);
    const { logits, next_state } = await this.#session.run(feeds);
    const { actions, logProbs } = sample(logits.data as Float32Array, rows, random);
    return { actions, logProbs, state: this.stateSize ? (next_state.data as Float32Array) : state };
  }
}

/** An action from each softmax policy, logits [E, A], by inverting its cumulative distribution. */
export function sample(logits: Float32Array, rows: number, random: () => number) {
  const choices = logits.length / rows;
  const actions = new Uint8Array(rows);
  const logProbs = new Float32Array(rows);
  for (let row = 0; row < rows; row++) {
    const shifted = logits.slice(row * choices, (row + 1) * choices);
    const largest = Math.max(...shifted);
    const weights = Array.from(shifted, (logit) => Math.exp(logit - largest));
    const total = weights.reduce((sum, weight) => sum + weight, 0);
    let left = random() * total;
    let action = 0;
    // The last choice takes what rounding leaves over.
    while (action < choices - 1 && left >= weights[action]) left -= weights[action++];
    actions[row] = action;
    logProbs[row] = shifted[action] - largest - Math.log(total);
  }
  return { actions, logProbs };
}
