// An actor in JavaScript for a Daedalus gateway, in a browser or in Node (22 or later), without any package.
//
//     node client.js ws://127.0.0.1:8080/actor NAME [EPISODES]
//
// It plays CartPole, whose equations are below. Start the run with `daedalus learner cartpole`.
// In a page: `import { play } from "./client.js"; await play("ws://127.0.0.1:8080/actor", "NAME", 100, console.log)`.

const SPACES = {
  observations: { observation: { kind: "array", shape: [4], dtype: "float32" } },
  actions: { action: { kind: "discrete", counts: [2] } },
};

/** Return the state of the cart 0.02 s later. */
export function cartpole([x, speed, angle, spin], action) {
  const force = (action ? 10 : -10) + 0.05 * spin * spin * Math.sin(angle);
  const leverage = 0.5 * (4 / 3 - (0.1 * Math.cos(angle) ** 2) / 1.1);
  const turn = (9.8 * Math.sin(angle) - (Math.cos(angle) * force) / 1.1) / leverage;
  const push = (force - 0.05 * turn * Math.cos(angle)) / 1.1;
  return [x + 0.02 * speed, speed + 0.02 * push, angle + 0.02 * spin, spin + 0.02 * turn];
}

/** Play episodes; `report` gets a line for each, and `onStep` the state of the cart after each step. */
export async function play(address, name, episodes, report, onStep = async () => {}) {
  const socket = new WebSocket(address);
  let [settle, end] = [null, null]; // the answer that is awaited, and why none comes any more
  const fail = (error) => settle.reject((end ??= error));
  socket.onmessage = ({ data }) => {
    const message = JSON.parse(data);
    if (["welcome", "action"].includes(message.type)) settle.resolve(message);
    else fail(new Error(message.reason));
  };
  socket.onclose = socket.onerror = () => fail(new Error("the connection to the gateway ended"));
  const answer = (begin) =>
    new Promise((resolve, reject) => {
      settle = { resolve, reject };
      end ? reject(end) : begin();
    });
  const ask = (message) => answer(() => socket.send(JSON.stringify(message)));
  await answer(() => (socket.onopen = () => settle.resolve()));
  report(`joined ${(await ask({ type: "hello", version: 1, name, ...SPACES })).run}`);
  for (let episode = 0; episode < episodes; episode++) {
    let state = Array.from({ length: 4 }, () => Math.random() * 0.1 - 0.05);
    let [fallen, steps] = [false, 0];
    for (; !fallen && steps < 500; steps++) {
      const reward = steps ? { reward: 1 } : {}; // of the last action
      state = cartpole(state, (await ask({ type: "act", observation: state, ...reward })).action);
      fallen = Math.abs(state[0]) > 2.4 || Math.abs(state[2]) > 0.2095;
      await onStep(state);
    }
    socket.send(JSON.stringify({ type: "end_episode", terminated: fallen, observation: state, reward: 1 }));
    report(`return ${steps}`);
  }
  socket.close();
}

if (globalThis.process?.argv[1]?.endsWith("client.js")) {
  const [address, name, episodes = 1e6] = process.argv.slice(2);
  await play(address, name, Number(episodes), console.log);
}
