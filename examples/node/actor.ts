/** Joins a learner, collects, uploads, follows its snapshots, leaves. */

import { setTimeout as sleep } from "node:timers/promises";
import { Bridge, BridgeError } from "./bridge.ts";
import { CartPoles, ID, SPACES } from "./cartpole.ts";
import { Collector } from "./collector.ts";
import * as link from "./link.ts";
import { type EnvironmentSpec, LearnerLostError, NameTakenError, RunOverError, RefusedError, type Welcome } from "./link.ts";
import { Policy } from "./policy.ts";
import { seeded } from "./random.ts";
import { type Acknowledgement, Uploader } from "./uploader.ts";
import { decodeWhole, encode, type Message } from "./wire.ts";

const RETRY_MILLISECONDS = 500; // between looks for the learner
const HEARTBEAT_MILLISECONDS = 200; // how soon a wait looks at the clock
const DOUBT_MILLISECONDS = 1_000; // so long without the snapshot that it needs, the actor asks for it
const SILENCE_MILLISECONDS = 10_000; // nothing heard for so long, the learner is asked whether it is there
const TAKEN_MILLISECONDS = 10_000; // for an earlier life of this actor to be found dead
const ACKNOWLEDGE_SECONDS = 30; // a saturated learner answers late

export interface ActorConfig {
  host: string;
  port: number; // of the bridge
  run: string; // `*`: whichever there is
  name: string; // survives restarts
  incarnation: bigint; // this life of the process
  environments?: number; // unset: as many as the learner asks for
}

export class Actor {
  readonly #config: ActorConfig;
  readonly #say: (text: string) => void;
  #uploader = new Uploader(-1, 1); // of the learner epoch that was joined last
  #snapshot?: Message; // the newest of that epoch
  #newsAt = 0; // when it came
  #toldVersion = 0; // the newest that an answer told of
  #heardAt = 0; // when the learner last said anything
  #rejected = false; // the last answer: collect another in its place
  #reason?: Error; // to stop playing, once there is one
  #stopped = false;
  #wake: () => void = () => {};

  constructor(config: ActorConfig, say: (text: string) => void) {
    this.#config = config;
    this.#say = say;
  }

  /** Plays until stopped or until the run is over; throws RefusedError, PolicyError or ProtocolError if it cannot. */
  async run(): Promise<void> {
    let told = "";
    let takenUntil = performance.now() + TAKEN_MILLISECONDS;
    while (!this.#stopped) {
      try {
        await this.#takePart(() => (told = ""));
      } catch (error) {
        if (error instanceof RunOverError) return this.#say(error.message);
        const passing = error instanceof LearnerLostError || error instanceof BridgeError;
        if (passing) takenUntil = performance.now() + TAKEN_MILLISECONDS;
        else if (!(error instanceof NameTakenError && performance.now() < takenUntil)) throw error;
        if (told !== error.message) this.#say(`${error.message}; looking for a learner`);
        told = error.message;
      }
      await sleep(RETRY_MILLISECONDS);
    }
  }

  /** Ends `run` soon. */
  stop(): void {
    this.#stopped = true;
    this.#end(new RunOverError("stopped"));
  }

  /** Over a connection of its own: asks what to play, is counted in, and plays until there is a reason to stop. */
  async #takePart(onJoined: () => void): Promise<never> {
    const { host, port, name, incarnation } = this.#config;
    const bridge = await Bridge.open(host, port);
    try {
      this.#snapshot = undefined;
      this.#reason = this.#stopped ? new RunOverError("stopped") : undefined;
      bridge.onClosed = (error) => this.#end(error);
      const asked = { actor: name, incarnation, spaces: null, environments: 0 };
      const { run, spec, learner_epoch } = await link.join(bridge, this.#config.run, asked);
      checkPlayable(spec.environment);
      if (this.#uploader.learnerEpoch !== learner_epoch) {
        this.#uploader = new Uploader(learner_epoch, spec.collection.window);
        this.#toldVersion = 0;
      }
      bridge.follow(`daedalus/${run}/snapshots`, (news) => this.#takeNews(news));
      bridge.watch(`daedalus/${run}/learner`, (_key, present) => {
        if (!present) this.#end(new LearnerLostError("the learner went away"));
      });
      bridge.announce(`daedalus/${run}/actors/${name}/${incarnation}`);
      const environments = this.#config.environments ?? spec.collection.envs_per_actor;
      const welcome = await link.join(bridge, run, { actor: name, incarnation, spaces: SPACES, environments });
      if (welcome.learner_epoch !== learner_epoch) throw new LearnerLostError("the learner was started again");
      this.#heardAt = performance.now();
      onJoined();
      this.#say(`joined run '${run}' as '${name}': ${environments} x ${ID}`);
      return await this.#play(bridge, welcome, environments);
    } finally {
      bridge.close();
    }
  }

  // -------------------------------------------------------------------------------------------- playing

  async #play(bridge: Bridge, welcome: Welcome, environments: number): Promise<never> {
    const { run, spec, seed, learner_epoch } = welcome;
    const uploader = this.#uploader;
    // What was never answered goes out once more: only the network may have failed, and not the learner.
    for (const sequence of uploader.pending.keys()) void this.#upload(bridge, run, sequence);
    this.#newsAt = 0; // it may be there already: to be asked for at once
    await this.#until(bridge, run, () => this.#snapshot !== undefined, DOUBT_MILLISECONDS);
    const hash = String(this.#snapshot!.fields.program);
    const policy = await Policy.load(await link.program(bridge, run, hash), hash);
    const random = seeded(seed);
    const { reward_clip, reward_scale, bootstrap_terminations, max_episode_steps } = spec.environment;
    const carts = new CartPoles(environments, random, max_episode_steps ?? undefined);
    const shaping = { clip: reward_clip, scale: reward_scale, bootstrap_terminations };
    const collector = new Collector(carts, policy, shaping, spec.collection.rollout_length, random);
    const synchronous = spec.training.algorithm === "a2c"; // it takes one rollout of each version
    for (let loaded = -1; ; ) {
      await this.#until(bridge, run, () => uploader.hasRoom); // before playing: what is played now is of the newest
      if (synchronous) {
        await this.#until(bridge, run, () => this.#version > loaded || this.#rejected, DOUBT_MILLISECONDS);
        this.#rejected = false;
      } else if (this.#toldVersion > this.#version && performance.now() > this.#newsAt + DOUBT_MILLISECONDS) {
        await this.#askNews(bridge, run);
      }
      if (this.#version !== loaded) policy.bind(weightsOf(this.#snapshot!));
      loaded = this.#version;
      const sequence = uploader.next();
      const identity = { actor: this.#config.name, incarnation: this.#config.incarnation, sequence, learner_epoch };
      uploader.pending.set(sequence, encode(await collector.collect(identity, loaded)));
      void this.#upload(bridge, run, sequence);
    }
  }

  async #upload(bridge: Bridge, run: string, sequence: number): Promise<void> {
    try {
      const answer = await this.#uploader.deliver(sequence, async (rollout) => {
        const key = `daedalus/${run}/rollouts/${this.#config.name}`;
        const [bytes] = await bridge.ask(key, rollout, ACKNOWLEDGE_SECONDS);
        if (bytes) this.#heardAt = performance.now();
        const answer = bytes && decodeWhole(bytes);
        return answer?.kind === "Acknowledgement" ? (answer.fields as unknown as Acknowledgement) : undefined;
      });
      this.#toldVersion = Math.max(this.#toldVersion, answer.policy_version);
      this.#rejected = answer.verdict === "rejected";
      if (answer.verdict === "finished") this.#end(new RunOverError("the run is over"));
      if (answer.verdict === "fenced") this.#end(new LearnerLostError("the learner lives another life"));
      if (answer.verdict === "quarantined") {
        this.#end(new RefusedError(`the learner takes nothing more of this actor: ${answer.reason}`));
      }
    } catch (error) {
      this.#end(error as Error); // the connection has gone, or what came over it was no message
    }
    this.#wake();
  }

  // ------------------------------------------------------------------------------------------ snapshots

  get #version(): number {
    return this.#snapshot ? Number(this.#snapshot.fields.policy_version) : -1;
  }

  #takeNews(bytes: Uint8Array): void {
    try {
      const news = decodeWhole(bytes);
      if (!news || (news.kind !== "RunEnded" && news.kind !== "Snapshot")) return;
      if (news.fields.learner_epoch !== this.#uploader.learnerEpoch) throw new LearnerLostError("another learner is here");
      if (news.kind === "RunEnded") throw new RunOverError(`the run is over: ${news.fields.reason}`);
      if (Number(news.fields.policy_version) > this.#version) this.#snapshot = news;
      this.#heardAt = this.#newsAt = performance.now();
      this.#wake();
    } catch (error) {
      this.#end(error as Error);
    }
  }

  /** Asks for the newest snapshot: it may not have come, or the learner may have gone without a word. */
  async #askNews(bridge: Bridge, run: string): Promise<void> {
    this.#newsAt = performance.now();
    const answers = await bridge.ask(`daedalus/${run}/snapshots`);
    if (answers.length === 0) throw new LearnerLostError("the learner is silent");
    this.#heardAt = performance.now();
    for (const answer of answers) this.#takeNews(answer);
  }

  // -------------------------------------------------------------------------------------------- waiting

  /** Waits until `ready`; meanwhile asks for news where silence, or a snapshot that is `due`, gives reason to. */
  async #until(bridge: Bridge, run: string, ready: () => boolean, due = Infinity): Promise<void> {
    for (;;) {
      if (this.#reason) throw this.#reason;
      if (ready()) return;
      const now = performance.now();
      if (now > this.#newsAt + due || now > this.#heardAt + SILENCE_MILLISECONDS) await this.#askNews(bridge, run);
      else await this.#somethingNew();
    }
  }

  #somethingNew(): Promise<void> {
    return new Promise((resolve) => {
      const timer = setTimeout(resolve, HEARTBEAT_MILLISECONDS);
      this.#wake = () => {
        clearTimeout(timer);
        resolve();
      };
    });
  }

  /** There is a reason to stop playing; the first one counts. */
  #end(reason: Error): void {
    this.#reason ??= reason;
    this.#wake();
  }
}

/** Throws RefusedError unless the run asks for CartPole as it is: nothing here changes pixels or actions. */
function checkPlayable(spec: EnvironmentSpec): void {
  const { id, kwargs, action_table, action_repeat, no_reward_limit, crop, grey, resize, frame_stack } = spec;
  const plain = !(action_table || no_reward_limit || crop || grey || resize || Object.keys(kwargs).length);
  if (id !== ID || !plain || action_repeat !== 1 || frame_stack !== 1) {
    throw new RefusedError(`the run asks for ${id}, or for more than this actor can do to it: it plays ${ID} as it is`);
  }
}

/** The weights of a snapshot, by the names of the program's inputs. */
function weightsOf(snapshot: Message): Message["arrays"] {
  const weights = Object.entries(snapshot.arrays).map(([name, array]) => [name.replace(/^weights\//, ""), array]);
  return Object.fromEntries(weights);
}
