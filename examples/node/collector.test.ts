/** What is played and what is gathered of it, without a learner. */

import assert from "node:assert/strict";
import { test } from "node:test";
import { CartPoles, SIZE } from "./cartpole.ts";
import { Collector } from "./collector.ts";
import { type Acting, sample } from "./policy.ts";
import { seeded } from "./random.ts";

const AS_IT_IS = { clip: null, scale: 1, bootstrap_terminations: false };

/** Always pushes right, and remembers how many rows of its episode it has seen. */
const pusher: Acting = {
  stateSize: 1,
  async act(observations, _shape, state) {
    const rows = observations.length / SIZE;
    return {
      actions: new Uint8Array(rows).fill(1),
      logProbs: new Float32Array(rows),
      state: state.map((seen) => seen + 1),
    };
  },
};

test("the cart moves as gymnasium's does", () => {
  const carts = new CartPoles(1, () => 0.5); // starts at rest
  for (const action of [1, 1, 0, 1, 1, 1, 1, 1]) assert.equal(carts.step([action]).terminated[0], 0);
  // From gymnasium 1.4: CartPole-v1 at rest, under the same actions.
  const expected = [0.07032239331784457, 1.1733332604275875, -0.10718632601076401, -1.8208258223678069];
  carts.observations.forEach((number, i) => assert.ok(Math.abs(number - expected[i]) < 1e-6));
});

test("an episode that lasts is cut at its limit", () => {
  const carts = new CartPoles(1, () => 0.5, 3);
  const cut = [1, 0, 1].map((action) => carts.step([action]).truncated[0]);
  assert.deepEqual(cut, [0, 0, 1]);
});

test("the row after an episode's end only resets, and nothing is remembered beyond it", async () => {
  const [rows, count] = [64, 3];
  const collector = new Collector(new CartPoles(count, seeded(1)), pusher, AS_IT_IS, rows, seeded(2));
  const first = await collector.collect({}, 0);
  const second = await collector.collect({}, 0);
  const of = (name: string) => [...first.arrays[name].data, ...second.arrays[name].data] as number[];
  const [terminated, truncated, valid, rewards] = ["terminated", "truncated", "valid", "rewards"].map(of);
  const [lengths, returns] = ["episode_lengths", "episode_returns"].map(of);
  const ends: number[] = [];
  for (let e = 0; e < count; e++) {
    for (let row = 0, length = 0; row < 2 * rows; row++) {
      const at = row * count + e;
      const afterEnd = row > 0 && terminated[at - count] === 1;
      assert.equal(valid[at], Number(!afterEnd));
      assert.equal(rewards[at], Number(!afterEnd));
      length = afterEnd ? 0 : length + 1;
      if (terminated[at]) ends.push(length);
    }
  }
  assert.ok(!truncated.includes(1));
  assert.ok(ends.length > 2 * count);
  assert.deepEqual([...lengths].sort(), [...ends].sort());
  assert.deepEqual(returns, lengths);
  // The second rollout begins where the first ended, with what was remembered since the last reset.
  const tail = first.arrays.frames.data.slice(rows * count * SIZE);
  assert.deepEqual(second.arrays.frames.data.slice(0, count * SIZE), tail);
  for (let e = 0; e < count; e++) {
    let since = 0;
    for (let row = 0; row < rows; row++) since = valid[row * count + e] ? since + 1 : 0;
    assert.equal(second.arrays.initial_state.data[e], since);
  }
});

test("learning's rewards and ends are not the true ones where the run says so", async () => {
  const shaping = { clip: 0.5, scale: 0.5, bootstrap_terminations: true };
  const collector = new Collector(new CartPoles(2, seeded(1)), pusher, shaping, 64, seeded(2));
  const { arrays } = await collector.collect({}, 0);
  assert.deepEqual(new Set(arrays.rewards.data as Float32Array), new Set([0.25, 0]));
  assert.ok(!(arrays.terminated.data as Uint8Array).includes(1));
  assert.ok((arrays.truncated.data as Uint8Array).includes(1));
  assert.deepEqual(Array.from(arrays.episode_returns.data, Number), Array.from(arrays.episode_lengths.data, Number));
});

test("samples follow the softmax of the logits", () => {
  const random = seeded(3);
  const logits = Float32Array.of(0, Math.log(3), -Infinity);
  let second = 0;
  for (let i = 0; i < 20_000; i++) {
    const { actions, logProbs } = sample(logits, 1, random);
    const expected = [Math.log(0.25), Math.log(0.75)][actions[0]];
    assert.ok(Math.abs(logProbs[0] - expected) < 1e-6);
    second += actions[0];
  }
  assert.ok(Math.abs(second / 20_000 - 0.75) < 0.02);
});
