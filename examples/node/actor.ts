/** The actor's service: join a learner, collect rollouts and upload them, follow its snapshots, leave. */

import { hostname } from "node:os";
import { setTimeout as sleep } from "node:timers/promises";
import { Gateway, GatewayError } from "./gateway.ts";
import { Collector } from "./collector.ts";
import { type Kind, kindOf, KINDS } from "./environments.ts";
import * as link from "./link.ts";
import { LearnerLostError, NameTakenError, RunOverError, RefusedError } from "./link.ts";
import { Policy } from "./policy.ts";
import { seeded } from "./random.ts";
import { type Acknowledgement, Uploader } from "./uploader.ts";
import { encode, type Message, tryDecode } from "./wire.ts";

const SOFTWARE = "daedalus-node"; // for an operator who reads the status
const RETRY_MILLISECONDS = 500; // between attempts to join
const HEARTBEAT_MILLISECONDS = 200; // how soon a wait notices a deadline
const MISSED_PUSH_MILLISECONDS = 1_000; // without the awaited snapshot for so long, request it
const SILENCE_MILLISECONDS = 10_000; // without any message for so long, check that the learner answers
const NAME_IN_USE_MILLISECONDS = 10_000; // until the network notices that an earlier incarnation of this actor is dead
const ACKNOWLEDGE_SECONDS = 30; // a saturated learner answers late

export interface ActorConfig {
  host: string; // of the gateway
  port: number; // of the gateway
  run: string; // `*`: any run
  name: string; // the same after a restart
  incarnation: bigint; // identifies this process
  environments?: number; // E; undefined: envs_per_actor of the run's specification
}

/** One actor. Its state about the learner is of the learner epoch that it joined last. */
export class Actor {
  readonly #config: ActorConfig;
  readonly #log: (text: string) => void;
  #run: string; // to join; the one that was joined first, if any would do
  #uploader = new Uploader(-1, 1);
  #snapshot?: Message; // the newest received
  #snapshotAt = 0; // when the last snapshot was received or requested; times are of performance.now()
  #publishedVersion = 0; // the newest policy version in an acknowledgement
  #heardAt = 0; // when the last message of the learner was received
  #rejected = false; // whether the last answer was a rejection: a2c then collects another rollout of that version
  #stopReason?: Error; // why collecting must stop; `run` decides by its type what follows
  #stopped = false; // whether `stop` was called
  #wake: () => void = () => {}; // ends the present wait for an event

  constructor(config: ActorConfig, log: (text: string) => void) {
    this.#config = config;
    this.#run = config.run;
    this.#log = log;
  }

  /** Collect until `stop` or the run's end. Throws RefusedError, PolicyError or ProtocolError if the actor cannot. */
  async run(): Promise<void> {
    let lastLogged = "";
    let nameInUseDeadline = performance.now() + NAME_IN_USE_MILLISECONDS;
    while (!this.#stopped) {
      try {
        await this.#joinAndCollect(() => (lastLogged = ""));
      } catch (error) {
        if (error instanceof RunOverError) return this.#log(error.message);
        const temporary = error instanceof LearnerLostError || error instanceof GatewayError;
        if (temporary) nameInUseDeadline = performance.now() + NAME_IN_USE_MILLISECONDS;
        else if (!(error instanceof NameTakenError && performance.now() < nameInUseDeadline)) throw error;
        if (lastLogged !== error.message) this.#log(`${error.message}; looking for a learner`);
        lastLogged = error.message;
      }
      await sleep(RETRY_MILLISECONDS);
    }
  }

  /** End `run` soon. */
  stop(): void {
    this.#stopped = true;
    this.#stopCollecting(new RunOverError("stopped"));
  }

  /** Connect to the gateway, join, and collect until an error ends the session. */
  async #joinAndCollect(onJoined: () => void): Promise<never> {
    const { host, port, name, incarnation } = this.#config;
    const gateway = await Gateway.open(host, port, name);
    try {
      this.#snapshot = undefined;
      this.#stopReason = this.#stopped ? new RunOverError("stopped") : undefined;
      gateway.onClosed = (error) => this.#stopCollecting(error);
      const origin = { host: hostname(), software: SOFTWARE, address: "" };
      const known = { actor: name, incarnation, origin, failure: "" };
      const inquiry = { ...known, spaces: null, environments: 0 };
      const { run, spec, learner_epoch } = await link.join(gateway, this.#run, inquiry);
      this.#run = run;
      const kind = supported(spec.environment, spec.collection.upload);
      if (this.#uploader.learnerEpoch !== learner_epoch) {
        this.#uploader = new Uploader(learner_epoch, spec.collection.window);
        this.#publishedVersion = 0;
      }
      gateway.follow(`daedalus/${run}/snapshots`, (bytes) => this.#onPublication(bytes));
      gateway.follow(`daedalus/${run}/end`, (bytes) => this.#onPublication(bytes));
      gateway.watch(`daedalus/${run}/learner`, (_key, present) => {
        if (!present) this.#stopCollecting(new LearnerLostError("the learner went away"));
      });
      gateway.announce(`daedalus/${run}/actors/${name}/${incarnation}`);
      const environments = this.#config.environments ?? spec.collection.envs_per_actor;
      const welcome = await link.join(gateway, run, { ...known, spaces: kind.spaces, environments });
      if (welcome.learner_epoch !== learner_epoch) throw new LearnerLostError("the learner was restarted");
      this.#heardAt = performance.now();
      onJoined();
      this.#log(`joined run '${run}' as '${name}': ${environments} x ${spec.environment.id}`);
      return await this.#collect(gateway, welcome, kind, environments);
    } finally {
      gateway.close();
    }
  }

  // ----------------------------------------------------------------------------------------- collecting

  /** Collect and upload until an error ends the session. */
  async #collect(gateway: Gateway, welcome: link.Welcome, kind: Kind, environments: number): Promise<never> {
    const { run, spec, seed, epsilon, learner_epoch } = welcome;
    const uploader = this.#uploader;
    // The same learner epoch was joined again: send the rollouts without a final acknowledgement once more.
    for (const sequence of uploader.pending.keys()) void this.#upload(gateway, run, sequence);
    this.#snapshotAt = 0; // request the first snapshot at once: it may have been published earlier
    await this.#waitUntil(gateway, run, () => this.#snapshot !== undefined, MISSED_PUSH_MILLISECONDS);
    const hash = String(this.#snapshot!.fields.program);
    const policy = await Policy.load(await link.program(gateway, run, hash), hash, epsilon);
    const random = seeded(seed);
    const vector = kind.make(environments, random, spec.environment.max_episode_steps ?? undefined);
    const { rollout_length } = spec.collection;
    const collector = new Collector(vector, kind.spaces, policy, spec.environment, rollout_length, random);
    // A synchronous algorithm uses one rollout of each policy version.
    const synchronous = spec.training.algorithm === "a2c" || spec.training.algorithm_record?.synchronous === true;
    for (let loaded = -1; ; ) {
      await this.#waitUntil(gateway, run, () => uploader.hasRoom); // before collecting, so that the newest policy acts
      if (synchronous) {
        // A rejected rollout is replaced, unless a newer version is out: another one of this version would be stale.
        const due = () => this.#version > loaded || (this.#rejected && this.#publishedVersion <= loaded);
        await this.#waitUntil(gateway, run, due, MISSED_PUSH_MILLISECONDS);
        this.#rejected = false;
      } else if (this.#publishedVersion > this.#version) {
        if (performance.now() > this.#snapshotAt + MISSED_PUSH_MILLISECONDS) await this.#requestSnapshot(gateway, run);
      }
      if (this.#version !== loaded) policy.bind(weightsOf(this.#snapshot!));
      loaded = this.#version;
      const sequence = uploader.nextSequence();
      const identity = { actor: this.#config.name, incarnation: this.#config.incarnation, sequence, learner_epoch };
      uploader.pending.set(sequence, encode(await collector.collect(identity, loaded)));
      void this.#upload(gateway, run, sequence);
    }
  }

  /** Send a rollout until its final acknowledgement, and do what the verdict requires. Never throws. */
  async #upload(gateway: Gateway, run: string, sequence: number): Promise<void> {
    try {
      const answer = await this.#uploader.deliver(sequence, async (rollout) => {
        const key = `daedalus/${run}/rollouts/${this.#config.name}`;
        const [bytes] = await gateway.query(key, rollout, ACKNOWLEDGE_SECONDS);
        if (bytes) this.#heardAt = performance.now();
        const answer = bytes && tryDecode(bytes);
        return answer?.kind === "Acknowledgement" ? (answer.fields as unknown as Acknowledgement) : undefined;
      });
      this.#publishedVersion = Math.max(this.#publishedVersion, answer.policy_version);
      this.#rejected = answer.verdict === "rejected";
      if (answer.verdict === "finished") this.#stopCollecting(new RunOverError("the run is over"));
      if (answer.verdict === "drained") this.#stopCollecting(new RunOverError("an operator drained this actor"));
      if (answer.verdict === "fenced") this.#stopCollecting(new LearnerLostError("the learner fenced a rollout"));
      if (answer.verdict === "quarantined") {
        const cause = `${answer.reason}; fix the cause and restart the actor`;
        this.#stopCollecting(new RefusedError(`the learner quarantined this actor: ${cause}`));
      }
    } catch (error) {
      this.#stopCollecting(error as Error); // the connection ended, or the answer has another protocol version
    }
    this.#wake();
  }

  // ------------------------------------------------------------------------------------------ snapshots

  /** The policy version of the newest snapshot, or -1 before the first. */
  get #version(): number {
    return this.#snapshot ? Number(this.#snapshot.fields.policy_version) : -1;
  }

  /** Receive a Snapshot or RunEnded, published or in answer to a request. Ignore any other message. Never throws. */
  #onPublication(bytes: Uint8Array): void {
    try {
      const message = tryDecode(bytes);
      if (message?.kind === "RunEnded") return this.#onRunEnded(message);
      if (message?.kind !== "Snapshot") return;
      const { learner_epoch, policy_version } = message.fields;
      if (learner_epoch !== this.#uploader.learnerEpoch) throw new LearnerLostError("another learner epoch began");
      if (Number(policy_version) > this.#version) this.#snapshot = message;
      this.#heardAt = this.#snapshotAt = performance.now();
      this.#wake();
    } catch (error) {
      this.#stopCollecting(error as Error);
    }
  }

  /** Obey RunEnded. A finished run is over whatever the epoch of the message. */
  #onRunEnded({ fields: { learner_epoch, outcome, reason } }: Message): void {
    if (outcome === "finished") this.#stopCollecting(new RunOverError(`the run is over: ${reason}`));
    else if (learner_epoch === this.#uploader.learnerEpoch)
      this.#stopCollecting(new LearnerLostError("the learner was stopped"));
  }

  /** Request the newest snapshot in case a push was lost. Throws LearnerLostError without an answer. */
  async #requestSnapshot(gateway: Gateway, run: string): Promise<void> {
    this.#snapshotAt = performance.now();
    const answers = await gateway.query(`daedalus/${run}/snapshots`);
    if (answers.length === 0) throw new LearnerLostError("the learner did not answer a request for its snapshot");
    this.#heardAt = performance.now();
    for (const answer of answers) this.#onPublication(answer);
  }

  // -------------------------------------------------------------------------------------------- waiting

  /**
   * Wait until `ready` returns true. Throws the reason if collecting must stop. Requests a snapshot if none came for
   * `snapshotTimeout` milliseconds, or no message at all for SILENCE_MILLISECONDS.
   */
  async #waitUntil(gateway: Gateway, run: string, ready: () => boolean, snapshotTimeout = Infinity): Promise<void> {
    for (;;) {
      if (this.#stopReason) throw this.#stopReason;
      if (ready()) return;
      const now = performance.now();
      const overdue = now > this.#snapshotAt + snapshotTimeout || now > this.#heardAt + SILENCE_MILLISECONDS;
      await (overdue ? this.#requestSnapshot(gateway, run) : this.#nextEvent());
    }
  }

  /** Wait for a message or a reason to stop, at most one heartbeat. */
  #nextEvent(): Promise<void> {
    return new Promise((resolve) => {
      const timer = setTimeout(resolve, HEARTBEAT_MILLISECONDS);
      this.#wake = () => {
        clearTimeout(timer);
        resolve();
      };
    });
  }

  /** Make the next wait throw `reason`. The end of the run counts, otherwise the first reason. */
  #stopCollecting(reason: Error): void {
    if (!this.#stopReason || reason instanceof RunOverError) this.#stopReason = reason;
    this.#wake();
  }
}

/** Return the environment of a run. Throw RefusedError for another one, kwargs and transforms: this actor has none. */
function supported(spec: link.EnvironmentSpec, upload: string): Kind {
  const { id, kwargs, training_kwargs, wrap, action_table, action_repeat, no_reward_limit, leave_out } = spec;
  const { crop, grey, resize, frame_stack } = spec;
  const kind = kindOf(id);
  const settings = {
    id: kind === undefined,
    kwargs: Object.keys(kwargs).length > 0,
    training_kwargs: Object.keys(training_kwargs).length > 0,
    action_repeat: action_repeat !== 1,
    leave_out: leave_out.length > 0,
    frame_stack: frame_stack !== 1,
    ...{ wrap, action_table, no_reward_limit, crop, grey, resize },
  };
  const unsupported = Object.entries(settings).flatMap(([name, isSet]) => (isSet ? [name] : []));
  if (upload !== "rollouts") unsupported.push("collection.upload");
  if (kind !== undefined && unsupported.length === 0) return kind;
  throw new RefusedError(
    `the run's environment ${id} has unsupported settings (${unsupported.join(", ")}): ` +
      `this actor supports only ${Object.keys(KINDS).join(", ")}, without kwargs and transforms; use a Python actor`,
  );
}

/** Return the weights of a snapshot by the names of the program's inputs. */
function weightsOf(snapshot: Message): Message["arrays"] {
  const weights = Object.entries(snapshot.arrays).map(([name, array]) => [name.replace(/^weights\//, ""), array]);
  return Object.fromEntries(weights);
}
