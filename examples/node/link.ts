/** The queries of an actor to learners: join and program. Functions without state. */

import type { Gateway } from "./gateway.ts";
import { encode, type Message, tryDecode } from "./wire.ts";

/** `environment` of the run's specification, except the settings that concern only the Python actor. */
export interface EnvironmentSpec {
  id: string;
  kwargs: Record<string, unknown>;
  training_kwargs: Record<string, unknown>;
  max_episode_steps: number | null;
  wrap: string | null;
  action_table: unknown;
  action_repeat: number;
  no_reward_limit: number | null;
  leave_out: string[];
  crop: unknown;
  grey: boolean;
  resize: unknown;
  frame_stack: number;
  reward_clip: number | null;
  reward_scale: number;
  bootstrap_terminations: boolean;
}

/** The fields of a Welcome that this actor uses. */
export interface Welcome {
  run: string;
  learner_epoch: number | bigint;
  seed: number;
  epsilon: number;
  spec: {
    environment: EnvironmentSpec;
    collection: { envs_per_actor: number; rollout_length: number; window: number; upload: string };
    training: { algorithm: string; algorithm_record: { synchronous: boolean } | null };
  };
}

/** The actor cannot take part; the message states the reason. */
export class RefusedError extends Error {}

/** Another actor of the same name takes part, or did a moment ago. */
export class NameTakenError extends RefusedError {}

/** The run ended, or the actor was asked to stop; the message states which. */
export class RunOverError extends Error {}

/** The learner left, or another learner epoch began; join again. */
export class LearnerLostError extends Error {}

/**
 * Send one request to join `run` (`*`: any run) and return the answer. Throws LearnerLostError without an answer, and
 * RefusedError or RunOverError if a learner refuses.
 */
export async function join(gateway: Gateway, run: string, fields: Message["fields"]): Promise<Welcome> {
  const request = encode({ kind: "Join", fields, arrays: {} });
  const answers = await query(gateway, `daedalus/${run}/join/${fields.actor}`, request);
  const welcomes = answers.filter((answer) => answer.kind === "Welcome");
  if (welcomes.length > 1) throw new RefusedError("several learners answer here: choose one with --run");
  if (welcomes.length === 1) return welcomes[0].fields as unknown as Welcome;
  const refusal = answers.find((answer) => answer.kind === "Refusal")?.fields;
  if (refusal?.code === "finished") throw new RunOverError("the run is over");
  if (refusal?.code === "drained") throw new RunOverError("an operator drained this actor");
  if (refusal?.code === "not_ready") throw new LearnerLostError(String(refusal.reason));
  const Kind = refusal?.code === "name_taken" ? NameTakenError : RefusedError;
  if (refusal) throw new Kind(`the learner refused this actor: ${refusal.reason}`);
  throw new LearnerLostError("no learner answers: check that the learner runs and that the gateway connects to it");
}

/** Return the ONNX model with a hash. Throws LearnerLostError if no learner has it. */
export async function program(gateway: Gateway, run: string, hash: string): Promise<Uint8Array> {
  for (const answer of await query(gateway, `daedalus/${run}/program/${hash}`)) {
    if (answer.kind === "Program") return answer.arrays.model.data as Uint8Array;
  }
  throw new LearnerLostError(`no learner has the program ${hash}`);
}

/** Send a query and return the decoded answers without the damaged ones. */
async function query(gateway: Gateway, key: string, payload?: Uint8Array): Promise<Message[]> {
  return (await gateway.query(key, payload)).map(tryDecode).filter((message) => message !== undefined);
}
