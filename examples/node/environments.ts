/** The environments of this actor, by the id that a run names. Add your own here. */

import { SPACES, VectorCartPole } from "./cartpole.ts";
import type { Spaces, VectorEnvironment } from "./environment.ts";
import { spaces, VectorNested } from "./nested.ts";

/** An environment that this actor plays. */
export interface Kind {
  spaces: Spaces;

  /** Return `count` environments; `maxSteps` truncates episodes, undefined: the environment's own limit. */
  make(count: number, random: () => number, maxSteps?: number): VectorEnvironment;
}

const nested = (masked: boolean): Kind => ({
  spaces: spaces(masked),
  make: (count, random) => new VectorNested(count, random, masked),
});

export const KINDS: Record<string, Kind> = {
  "CartPole-v1": { spaces: SPACES, make: (count, random, maxSteps) => new VectorCartPole(count, random, maxSteps) },
  "Nested-v0": nested(false),
  "NestedMasked-v0": nested(true),
};

/** Return the environment with an id. The module of `module:id` is Python's, and plays no part here. */
export function kindOf(id: string): Kind | undefined {
  const name = id.slice(id.lastIndexOf(":") + 1);
  return Object.hasOwn(KINDS, name) ? KINDS[name] : undefined;
}
