/** Tests of the environments, the collector and the random numbers, without a learner. */

import assert from "node:assert/strict";
import { test } from "node:test";
import { ACTION, OBSERVATION, SIZE, SPACES, VectorCartPole } from "./cartpole.ts";
import { Collector } from "./collector.ts";
import { unscaled } from "./environment.ts";
import { spaces, VectorNested } from "./nested.ts";
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
  for (const action of [1, 1, 0, 1, 1, 1, 1, 1]) assert.equal(environments.step({ [ACTION]: Int32Array.of(action) }).terminated[0], 0);
  // From CartPole-v1 of gymnasium 1.4, with the same initial state and actions.
  const expected = [0.07032239331784457, 1.1733332604275875, -0.10718632601076401, -1.8208258223678069];
  const observed = [...environments.observations[OBSERVATION].data] as number[];
  observed.forEach((number, i) => assert.ok(Math.abs(number - expected[i]) < 1e-6));
});

test("an episode is truncated at its limit of steps", () => {
  const environments = new VectorCartPole(1, () => 0.5, 3);
  const truncated = [1, 0, 1].map((action) => environments.step({ [ACTION]: Int32Array.of(action) }).truncated[0]);
  assert.deepEqual(truncated, [0, 0, 1]);
});

test("the row after an episode's end only resets, and clears the state of the memory", async () => {
  const [rows, count] = [64, 3];
  const collector = new Collector(new VectorCartPole(count, seeded(1)), SPACES, pusher, UNCHANGED, rows, seeded(2));
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
  const collector = new Collector(new VectorCartPole(2, seeded(1)), SPACES, pusher, settings, 64, seeded(2));
  const { arrays } = await collector.collect({}, 0);
  assert.deepEqual(new Set(arrays.rewards.data as Float32Array), new Set([0.25, 0]));
  assert.ok(!(arrays.terminated.data as Uint8Array).includes(1));
  assert.ok((arrays.truncated.data as Uint8Array).includes(1));
  assert.deepEqual(Array.from(arrays.episode_returns.data, Number), Array.from(arrays.episode_lengths.data, Number));
});

/** A policy that takes the first legal stripe and the same numbers otherwise. */
const legal: BehaviourPolicy = {
  stateSize: 0,
  async act(observations, state, masks) {
    const rows = observations["sensors.code"].shape[0];
    const stripes = Int32Array.from({ length: rows }, (_, e) => masks["0"].data.indexOf(1 as never, 4 * e) - 4 * e);
    const actions = { "0": stripes, "1": new Float32Array(rows).fill(0.25), "2": new Int32Array(2 * rows).fill(1) };
    return { actions, logProbs: new Float32Array(rows), state };
  },
};

test("a rollout has all components and masks, and rewards that agree with them", async () => {
  const [rows, count] = [20, 2];
  const environments = new VectorNested(count, seeded(1), true);
  const collector = new Collector(environments, spaces(true), legal, UNCHANGED, rows, seeded(2));
  const { arrays } = await collector.collect({}, 0);
  const shapes = Object.fromEntries(Object.entries(arrays).map(([name, { dtype, shape }]) => [name, [dtype, ...shape]]));
  assert.deepEqual(shapes["frames/camera.image"], ["|u1", rows + 1, count, 20, 20]);
  assert.deepEqual(shapes["frames/sensors.code"], ["|u1", rows + 1, count, 1]);
  assert.deepEqual(shapes["frames/sensors.level"], ["<f4", rows + 1, count, 1]);
  assert.deepEqual(shapes["actions/0"], ["|u1", rows, count, 1]);
  assert.deepEqual(shapes["actions/1"], ["<f4", rows, count, 1]);
  assert.deepEqual(shapes["actions/2"], ["|u1", rows, count, 2]);
  assert.deepEqual(shapes["masks/0"], ["|b1", rows, count, 4]);
  for (let at = 0; at < rows * count; at++) {
    const mask = arrays["masks/0"].data.slice(4 * at, 4 * at + 4);
    const image = arrays["frames/camera.image"].data.slice(400 * at, 400 * at + 20);
    const bright = [0, 5, 10, 15].findIndex((column) => Number(image[column]) >= 128);
    assert.equal(mask[bright], 1); // the bright stripe is always legal
    if (!arrays.valid.data[at]) {
      assert.deepEqual([...mask], [1, 1, 1, 1]);
      assert.equal(arrays.rewards.data[at], 0);
      continue;
    }
    const distance = Math.abs(0.25 - Number(arrays["frames/sensors.level"].data[at])); // 0.25 is 1.25 of 0 to 2
    const right = Number(arrays["actions/0"].data[at] === bright) + Number(arrays["frames/sensors.code"].data[at] === 3);
    const expected = (right + Math.max(0, 1 - 2 * distance)) / 3;
    assert.ok(Math.abs(Number(arrays.rewards.data[at]) - expected) < 1e-6);
  }
  assert.deepEqual([...arrays.episode_lengths.data].map(Number), [8, 8, 8, 8]);
});

test("continuous actions are scaled to their bounds, and clipped to one bound", () => {
  const space = { kind: "continuous" as const, low: [-2, 0, null], high: [4, null, null] };
  assert.deepEqual([-1, 0, 3].map((value) => unscaled(space, 0, value)), [-2, 1, 4]);
  assert.deepEqual([-1, 7].map((value) => unscaled(space, 1, value)), [0, 7]);
  assert.equal(unscaled(space, 2, -9), -9);
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
