/** Tests of the environments, the collector and the random numbers, without a learner. */

import assert from "node:assert/strict";
import { test } from "node:test";
import { ACTION, OBSERVATION, SIZE, VectorCartPole } from "./cartpole.ts";
import { Collector } from "./collector.ts";
import type { BehaviourPolicy } from "./policy.ts";
import { normal, seeded, uniform } from "./random.ts";

const FRAMES = `frames/${OBSERVATION}`;
const UNCHANGED = { reward_clip: null, reward_scale: 1, bootstrap_terminations: false };

/** A policy that always pushes right. Its state counts the rows of the episode. */
const pusher: BehaviourPolicy = {
  stateSize: 1,
  async act(observations, state) {
    const rows = observations[OBSERVATION].shape[0];
    return {
      actions: { [ACTION]: new Int32Array(rows).fill(1) },
      logProbs: new Float32Array(rows),
      state: state.map((count) => count + 1),
    };
  },
};

test("the environment moves as gymnasium's CartPole-v1", () => {
  const environments = new VectorCartPole(1, () => 0.5); // the initial state is zero
  for (const action of [1, 1, 0, 1, 1, 1, 1, 1]) assert.equal(environments.step([action]).terminated[0], 0);
  // From CartPole-v1 of gymnasium 1.4, with the same initial state and actions.
  const expected = [0.07032239331784457, 1.1733332604275875, -0.10718632601076401, -1.8208258223678069];
  environments.observations.forEach((number, i) => assert.ok(Math.abs(number - expected[i]) < 1e-6));
});

test("an episode is truncated at its limit of steps", () => {
  const environments = new VectorCartPole(1, () => 0.5, 3);
  const truncated = [1, 0, 1].map((action) => environments.step([action]).truncated[0]);
  assert.deepEqual(truncated, [0, 0, 1]);
});

test("the row after an episode's end only resets, and clears the state of the memory", async () => {
  const [rows, count] = [64, 3];
  const collector = new Collector(new VectorCartPole(count, seeded(1)), pusher, UNCHANGED, rows, seeded(2));
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
  // The second rollout begins with the last frame of the first, and with the state since the last reset.
  const lastFrame = first.arrays[FRAMES].data.slice(rows * count * SIZE);
  assert.deepEqual(second.arrays[FRAMES].data.slice(0, count * SIZE), lastFrame);
  for (let e = 0; e < count; e++) {
    let since = 0;
    for (let row = 0; row < rows; row++) since = valid[row * count + e] ? since + 1 : 0;
    assert.equal(second.arrays.initial_state.data[e], since);
  }
});

test("a rollout has clipped and scaled rewards and bootstraps terminations if the run requires it", async () => {
  const settings = { reward_clip: 0.5, reward_scale: 0.5, bootstrap_terminations: true };
  const collector = new Collector(new VectorCartPole(2, seeded(1)), pusher, settings, 64, seeded(2));
  const { arrays } = await collector.collect({}, 0);
  assert.deepEqual(new Set(arrays.rewards.data as Float32Array), new Set([0.25, 0]));
  assert.ok(!(arrays.terminated.data as Uint8Array).includes(1));
  assert.ok((arrays.truncated.data as Uint8Array).includes(1));
  assert.deepEqual(Array.from(arrays.episode_returns.data, Number), Array.from(arrays.episode_lengths.data, Number));
});

test("uniform and normal numbers have their moments, and uniform ones never reach 1", () => {
  const mean = (values: Float32Array) => values.reduce((sum, value) => sum + value, 0) / values.length;
  const flat = uniform(20_000, seeded(3));
  assert.ok(Math.abs(mean(flat) - 0.5) < 0.01);
  assert.deepEqual(uniform(2, () => 1 - 2 ** -32), Float32Array.of(1 - 2 ** -24, 1 - 2 ** -24));
  const bell = normal(20_000, seeded(4));
  assert.ok(Math.abs(mean(bell)) < 0.03);
  assert.ok(Math.abs(mean(bell.map((value) => value ** 2)) - 1) < 0.04);
  assert.ok(Math.abs(mean(bell.map((value) => value ** 4)) - 3) < 0.3);
  assert.ok(normal(2, () => 0).every(Number.isFinite));
});
