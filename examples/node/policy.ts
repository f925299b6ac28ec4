/** The learner's ONNX program with the weights of a snapshot. No network, no environments. */

import { createHash } from "node:crypto";
import { InferenceSession, Tensor } from "onnxruntime-node";
import { normal, uniform } from "./random.ts";
import type { WireArray } from "./wire.ts";

/** This actor cannot use the program or the weights. */
export class PolicyError extends Error {}

/** Arrays by the names of their components, each with a first axis E. */
export type Components = Record<string, WireArray>;

/** What the policy chose for one row. */
export interface Choice {
  actions: Record<string, Int32Array | Float32Array>; // of each component [E, D]
  logProbs: Float32Array; // [E] log-probabilities of the whole actions
  state: Float32Array; // [E, S] input of the next row
}

/** Interface of a policy that a collector uses. */
export interface BehaviourPolicy {
  readonly stateSize: number; // S; 0 without a memory

  /** Sample actions for the observations of E environments, with the memory's state [E, S] and masks of actions. */
  act(observations: Components, state: Float32Array, masks: Components, random: () => number): Promise<Choice>;
}

const TENSOR_TYPES = { "<f4": "float32", "|u1": "uint8", "|b1": "bool" } as const;

/** A program in onnxruntime, and the weights that it was bound to last. */
export class Policy implements BehaviourPolicy {
  readonly stateSize: number;
  readonly #session: InferenceSession;
  readonly #epsilon: number; // how much this actor explores in the end; 0: it does not
  readonly #inputs: Map<string, InferenceSession.TensorValueMetadata>; // all but the weights
  readonly #weightShapes: Map<string, readonly (number | string)[]>; // by input name
  #weights: Record<string, Tensor> = {};

  /**
   * Load an ONNX model, to explore with `epsilon` of the actor's Welcome. Throws PolicyError unless `hash` is its SHA-256
   * and this actor supports the program.
   */
  static async load(model: Uint8Array, hash: string, epsilon = 0): Promise<Policy> {
    const actual = createHash("sha256").update(model).digest("hex");
    if (actual !== hash) throw new PolicyError(`the program has the hash ${actual}, but ${hash} was requested`);
    const session = await InferenceSession.create(model, {
      intraOpNumThreads: 1,
      interOpNumThreads: 1,
      // A model may name external files for its tensors. The sender must not be able to read files: use no folder.
      extra: { session: { model_external_initializers_file_folder_path: "/dev/null" } },
    });
    return new Policy(session, epsilon);
  }

  private constructor(session: InferenceSession, epsilon: number) {
    this.#session = session;
    this.#epsilon = epsilon;
    this.#inputs = new Map();
    this.#weightShapes = new Map();
    for (const input of session.inputMetadata) {
      if (!input.isTensor) throw new PolicyError(`the program's input '${input.name}' must be a tensor`);
      const isWeight = !/^(observations\/.*|masks\/.*|uniform|normal|state|epsilon)$/s.test(input.name);
      if (isWeight) this.#weightShapes.set(input.name, input.shape);
      else this.#inputs.set(input.name, input);
      if (isWeight && input.type !== "float32") {
        throw new PolicyError(`the program's weights '${input.name}' must be float32`);
      }
    }
    const outputs = session.outputNames;
    if (!outputs.some((name) => name.startsWith("actions/")) || !outputs.includes("log_prob")) {
      throw new PolicyError("the program must compute 'actions/NAME' and 'log_prob'");
    }
    if (epsilon > 0 && !this.#size("epsilon")) {
      throw new PolicyError(`the learner asks this actor to explore with epsilon ${epsilon}, but its program cannot`);
    }
    this.stateSize = this.#size("state");
    if (this.stateSize && !outputs.includes("next_state")) {
      throw new PolicyError("the program must compute 'next_state' from 'state'");
    }
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

  async act(observations: Components, state: Float32Array, masks: Components, random: () => number): Promise<Choice> {
    const rows = Object.values(observations)[0].shape[0];
    const feeds: Record<string, Tensor> = { ...this.#weights };
    for (const [name, array] of Object.entries(observations)) this.#set(feeds, `observations/${name}`, array);
    for (const [name, array] of Object.entries(masks)) this.#set(feeds, `masks/${name}`, array);
    for (const [name, draw] of [["uniform", uniform], ["normal", normal]] as const) {
      const size = this.#size(name);
      if (size) feeds[name] = new Tensor("float32", draw(rows * size, random), [rows, size]);
    }
    if (this.#size("epsilon")) feeds.epsilon = new Tensor("float32", new Float32Array(rows).fill(this.#epsilon), [rows, 1]);
    if (this.stateSize) feeds.state = new Tensor("float32", state, [rows, this.stateSize]);
    const outputs = await this.#session.run(feeds);
    const actions: Choice["actions"] = {};
    for (const [name, { type, data }] of Object.entries(outputs)) {
      if (!name.startsWith("actions/")) continue;
      const whole = type === "int64" ? Int32Array.from(data as BigInt64Array, Number) : (data as Float32Array);
      actions[name.slice("actions/".length)] = whole;
    }
    const next = this.stateSize ? (outputs.next_state.data as Float32Array) : state;
    return { actions, logProbs: outputs.log_prob.data as Float32Array, state: next };
  }

  /** Set an input of a component. A component that the network does not use is not in the program. */
  #set(feeds: Record<string, Tensor>, name: string, { dtype, shape, data }: WireArray): void {
    const input = this.#inputs.get(name);
    if (!input) return;
    if (input.type === "int64") {
      // Discrete observations, which messages hold in fewer bits.
      feeds[name] = new Tensor("int64", BigInt64Array.from(data as Uint8Array, BigInt), shape);
      return;
    }
    const type = TENSOR_TYPES[dtype as keyof typeof TENSOR_TYPES];
    if (type !== input.type) throw new PolicyError(`the program's input '${name}' is ${input.type}, not ${dtype}`);
    feeds[name] = new Tensor(type, data as Uint8Array, shape);
  }

  /** Return the second dimension of an input, or 0 if the program does not have it. */
  #size(name: string): number {
    return Number(this.#inputs.get(name)?.shape[1] ?? 0);
  }
}
