/** What an actor asks of learners: to be found, to be let in, for programs and snapshots. No state. */

import type { Bridge } from "./bridge.ts";
import { decodeWhole, encode, type Message } from "./wire.ts";

export interface EnvironmentSpec {
  id: string;
  kwargs: Record<string, unknown>;
  max_episode_steps: number | null;
  action_table: unknown;
  action_repeat: number;
  no_reward_limit: number | null;
  crop: unknown;
  grey: boolean;
  resize: unknown;
  frame_stack: number;
  reward_clip: number | null;
  reward_scale: number;
  bootstrap_terminations: boolean;
}

/** What the answer to a Join holds, as far as this actor needs it. */
export interface Welcome {
  run: string;
  learner_epoch: number | bigint;
  seed: number;
  spec: {
    environment: EnvironmentSpec;
    collection: { envs_per_actor: number; rollout_length: number; window: number };
    training: { algorithm: string };
  };
}

/** The actor cannot take part; the message says why. */
export class RefusedError extends Error {}

/** Another actor of that name takes part, or did a moment ago. */
export class NameTakenError extends RefusedError {}

/** The run is over, or the actor was told to stop; the message says which. */
export class RunOverError extends Error {}

/** The learner went away, or lives another life; join again. */
export class LearnerLostError extends Error {}

/** Asks to take part in a run, `*` for any. */
export async function join(bridge: Bridge, run: string, fields: Message["fields"]): Promise<Welcome> {
  const answers = await ask(bridge, `daedalus/${run}/join`, encode({ kind: "Join", fields, arrays: {} }));
  const welcomes = answers.filter((answer) => answer.kind === "Welcome");
  if (welcomes.length > 1) throw new RefusedError("several learners answer here: choose one with --run");
  if (welcomes.length === 1) return welcomes[0].fields as unknown as Welcome;
  const refusal = answers.find((answer) => answer.kind === "Refusal")?.fields;
  if (refusal?.code === "finished") throw new RunOverError("the run is over");
  const Kind = refusal?.code === "name_taken" ? NameTakenError : RefusedError;
  if (refusal) throw new Kind(`the learner refused this actor: ${refusal.reason}`);
  throw new LearnerLostError("no learner answers");
}

/** The ONNX model with that hash. */
export async function program(bridge: Bridge, run: string, hash: string): Promise<Uint8Array> {
  for (const answer of await ask(bridge, `daedalus/${run}/program/${hash}`)) {
    if (answer.kind === "Program") return answer.arrays.model.data as Uint8Array;
  }
  throw new LearnerLostError("nobody has the program");
}

async function ask(bridge: Bridge, key: string, payload?: Uint8Array): Promise<Message[]> {
  return (await bridge.ask(key, payload)).map(decodeWhole).filter((message) => message !== undefined);
}
