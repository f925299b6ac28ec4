// A typed client of a Daedalus gateway in TypeScript: Node 22.18 or later runs this file, without any package.
//
//     node client.ts ws://127.0.0.1:8080/actor NAME [EPISODES]
//
// It plays CartPole, whose equations are below. Start the run with `daedalus learner cartpole`. The types are those of
// gateway/protocol.json. For an environment of your own, change what follows the class.

type Component =
  | { kind: "array"; shape: number[]; dtype: "float32" | "uint8" } // of observations
  | { kind: "discrete"; counts: number[]; masked?: boolean }
  | { kind: "continuous"; low: (number | null)[]; high: (number | null)[] }; // of actions
type Spaces = { observations: Record<string, Component>; actions: Record<string, Component> };

type Hello = { type: "hello"; version: 1; name: string; token?: string } & Spaces;
type Act<O, A> = { type: "act"; observation: O; action_mask?: boolean[]; reward?: number; override?: A };
// The observation is required if a limit cut the episode: its value is learned from.
type Ending<O> = { reward?: number } & ({ terminated: true; observation?: O } | { terminated: false; observation: O });
type Reward = { type: "reward"; reward: number };
type ToGateway<O, A> = Hello | Act<O, A> | Reward | ({ type: "end_episode" } & Ending<O>);

type Welcome = { type: "welcome"; version: 1; run: string; environment: string; name: string };
type Code = "malformed" | "out_of_turn" | "misfit" | "refused" | "unavailable";
type FromGateway<A> =
  | Welcome
  | { type: "action"; action: A }
  | { type: "error"; code: Code; reason: string }
  | { type: "run_ended"; reason: string };

/** One connection. Once an answer is not the expected one, every later call fails with the same reason. */
class Actor<O, A> {
  readonly #socket: WebSocket;
  #answer = Promise.withResolvers<FromGateway<A>>();

  constructor(address: string) {
    this.#socket = new WebSocket(address);
    this.#socket.onmessage = ({ data }) => this.#answer.resolve(JSON.parse(data as string) as FromGateway<A>);
    this.#socket.onclose = this.#socket.onerror = () =>
      this.#answer.resolve({ type: "error", code: "unavailable", reason: "the connection to the gateway ended" });
  }

  async join(name: string, spaces: Spaces): Promise<Welcome> {
    this.#socket.onopen = () => this.#send({ type: "hello", version: 1, name, ...spaces });
    return this.#take("welcome");
  }

  /** Return the policy's action. The reward is that of the last action. */
  async act(observation: O, reward: number): Promise<A> {
    this.#send({ type: "act", observation, reward });
    return (await this.#take("action")).action;
  }

  endEpisode(ending: Ending<O>): void {
    this.#send({ type: "end_episode", ...ending });
  }

  close(): void {
    this.#socket.close();
  }

  #send(message: ToGateway<O, A>): void {
    this.#socket.send(JSON.stringify(message));
  }

  async #take<T extends FromGateway<A>["type"]>(wanted: T): Promise<Extract<FromGateway<A>, { type: T }>> {
    const answer = await this.#answer.promise;
    if (answer.type !== wanted) throw new Error("reason" in answer ? answer.reason : `unexpected: ${answer.type}`);
    this.#answer = Promise.withResolvers();
    return answer as Extract<FromGateway<A>, { type: T }>;
  }
}

type State = [x: number, speed: number, angle: number, spin: number];
const SPACES: Spaces = {
  observations: { observation: { kind: "array", shape: [4], dtype: "float32" } },
  actions: { action: { kind: "discrete", counts: [2] } },
};

function cartpole([x, speed, angle, spin]: State, action: number): State {
  const force = (action ? 10 : -10) + 0.05 * spin * spin * Math.sin(angle);
  const leverage = 0.5 * (4 / 3 - (0.1 * Math.cos(angle) ** 2) / 1.1);
  const turn = (9.8 * Math.sin(angle) - (Math.cos(angle) * force) / 1.1) / leverage;
  const push = (force - 0.05 * turn * Math.cos(angle)) / 1.1;
  return [x + 0.02 * speed, speed + 0.02 * push, angle + 0.02 * spin, spin + 0.02 * turn];
}

const [address = "ws://127.0.0.1:8080/actor", name = "ts-1", episodes = "1000000"] = process.argv.slice(2);
const actor = new Actor<State, number>(address);
console.log(`joined ${(await actor.join(name, SPACES)).run}`);
const small = (): number => Math.random() * 0.1 - 0.05;
for (let episode = 0; episode < Number(episodes); episode++) {
  let [state, steps, fallen]: [State, number, boolean] = [[small(), small(), small(), small()], 0, false];
  for (; !fallen && steps < 500; steps++) {
    state = cartpole(state, await actor.act(state, steps ? 1 : 0));
    fallen = Math.abs(state[0]) > 2.4 || Math.abs(state[2]) > 0.2095;
  }
  actor.endEpisode({ terminated: fallen, observation: state, reward: 1 });
  console.log(`return ${steps}`);
}
actor.close();
