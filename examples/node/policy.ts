/** The learner's ONNX program with the weights of a snapshot. No network, no environments. */

import { createHash } from "node:crypto";
import { InferenceSession, Tensor } from "onnxruntime-node";
import type { WireArray } from "./wire.ts";

/** This actor cannot use the program or the weights. */
export class PolicyError extends Error {}

/** Sampled actions of one row. */
export interface SampledRow {
  actions: Uint8Array; // [E]
  logProbs: Float32Array; // [E] log-probabilities of the actions
  state: Float32Array; // [E, S] input of the next row
}

/** Interface of a policy that a collector uses. */
export interface BehaviourPolicy {
  readonly stateSize: number; // S; 0 without a memory

  /** Sample an action for each observation [E, ...shape] with the memory's state [E, S]. */
  act(observations: Float32Array, shape: number[], state: Float32Array, random: () => number): Promise<SampledRow>;
}

/** A program in onnxruntime, and the weights that it was bound to last. */
export class Policy implements BehaviourPolicy {
  readonly stateSize: number;
  readonly #session: InferenceSession;
  readonly #weightShapes: Map<string, readonly (number | string)[]>; // by input name
  #weights: Record<string, Tensor> = {};

  /** Load an ONNX model. Throws PolicyError unless `hash` is its SHA-256 and this actor supports the program. */
  static async load(model: Uint8Array, hash: string): Promise<Policy> {
    const actual = createHash("sha256").update(model).digest("hex");
    if (actual !== hash) throw new PolicyError(`the program has the hash ${actual}, but ${hash} was requested`);
    const session = await InferenceSession.create(model, {
      intraOpNumThreads: 1,
      interOpNumThreads: 1,
      // A model may name external files for its tensors. The sender must not be able to read files: use no folder.
      extra: { session: { model_external_initializers_file_folder_path: "/dev/null" } },
    });
    return new Policy(session);
  }

  private constructor(session: InferenceSession) {
    this.#session = session;
    this.#weightShapes = new Map();
    let stateSize = 0;
    for (const input of session.inputMetadata) {
      if (!input.isTensor || input.type !== "float32") {
        throw new PolicyError(`the program's input '${input.name}' must be a float32 tensor`);
      }
      if (input.name === "state") stateSize = Number(input.shape[1]);
      else if (input.name !== "observations") this.#weightShapes.set(input.name, input.shape);
    }
    if (!session.inputNames.includes("observations") || session.outputNames[0] !== "logits") {
      throw new PolicyError("the program must compute 'logits' from 'observations'");
    }
    this.stateSize = stateSize;
  }

  /** Use these weights from the next `act` on. Throws PolicyError if they do not match the program's inputs. */
  bind(weights: Record<string, WireArray>): void {
    const bound: Record<string, Tensor> = {};
    for (const [name, shape] of this.#weightShapes) {
      const given = weights[name];
      if (given?.dtype !== "<f4" || String(given.shape) !== String(shape)) {
        throw new PolicyError(`the snapshot has no float32 weights '${name}' of shape [${shape}]`);
      }
      bound[name] = new Tensor("float32", given.data as Float32Array, given.shape);
    }
    this.#weights = bound;
  }

  async act(
    observations: Float32Array,
    shape: number[],
    state: Float32Array,
    random: () => number,
  ): Promise<SampledRow> {
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

/**
 * Sample an action from the softmax of each row of logits [E, A], by inverting the cumulative distribution.
 *
 * Returns the actions [E] and their log-probabilities [E].
 */
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
    // Stop at the last action: because of rounding, the weights may sum to less than `left`.
    while (action < choices - 1 && left >= weights[action]) left -= weights[action++];
    actions[row] = action;
    logProbs[row] = shifted[action] - largest - Math.log(total);
  }
  return { actions, logProbs };
}
