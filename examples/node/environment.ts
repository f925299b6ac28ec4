/** Environments as the collector sees them: their spaces, and what a step returns. Pure. */

import type { Choice, Components } from "./policy.ts";
import type { Dtype } from "./wire.ts";

/** An array of an observation. This actor stacks no frames. */
export interface ArraySpace {
  kind: "array";
  shape: number[];
  dtype: "float32" | "uint8";
  frames: 1;
}

/** Discrete variables with so many choices each, counted from 0. Masks say which choices of an action are legal. */
export interface DiscreteSpace {
  kind: "discrete";
  counts: number[];
  masked: boolean;
}

/** Numbers of an action. In messages a number with both bounds is scaled to [-1, 1], see `unscaled`. */
export interface ContinuousSpace {
  kind: "continuous";
  low: (number | null)[];
  high: (number | null)[];
}

/** Named components of observations and actions, as in a Join: nested spaces are flattened, and joined by dots. */
export interface Spaces {
  observations: Record<string, ArraySpace | DiscreteSpace>;
  actions: Record<string, DiscreteSpace | ContinuousSpace>;
}

/** Outcome of one step of E environments. */
export interface Step {
  rewards: Float32Array; // [E]
  terminated: Uint8Array; // [E]
  truncated: Uint8Array; // [E]
}

/**
 * E environments, reset by gymnasium's NEXT_STEP rule: the step after the end of an episode ignores its action and only
 * resets.
 */
export interface VectorEnvironment {
  readonly count: number; // E
  readonly observations: Components; // the current ones, each [E, *shape]
  readonly masks: Components; // of each masked action [E, choices]: all ones where the next step only resets
  step(actions: Choice["actions"]): Step;
}

/** Return data type and shape of one value of a component, as messages have it. */
export function layout(space: ArraySpace | DiscreteSpace | ContinuousSpace): { dtype: Dtype; shape: number[] } {
  if (space.kind === "array") return { dtype: space.dtype === "uint8" ? "|u1" : "<f4", shape: space.shape };
  if (space.kind === "continuous") return { dtype: "<f4", shape: [space.low.length] };
  return { dtype: Math.max(...space.counts) <= 256 ? "|u1" : "<u2", shape: [space.counts.length] };
}

/** Return number `i` of an action as the environment has it: scaled to its bounds, and within them. */
export function unscaled({ low, high }: ContinuousSpace, i: number, value: number): number {
  const [least, most] = [low[i] ?? -Infinity, high[i] ?? Infinity];
  const bounded = Number.isFinite(least) && Number.isFinite(most);
  return Math.min(Math.max(bounded ? least + (value + 1) * 0.5 * (most - least) : value, least), most);
}
