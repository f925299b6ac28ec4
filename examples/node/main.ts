/** `node main.ts --help`. Exit status: 0 the run is over or told to stop, 1 failed, 2 bad usage. */

import { randomBytes } from "node:crypto";
import { parseArgs } from "node:util";
import { Actor, type ActorConfig } from "./actor.ts";
import { RefusedError } from "./link.ts";
import { PolicyError } from "./policy.ts";
import { ProtocolError } from "./wire.ts";

const USAGE = `\
usage: node main.ts [--bridge HOST:PORT] [--run NAME] [--name NAME] [--envs E]

Plays CartPole for a learner, by way of \`daedalus bridge\`.

  --bridge HOST:PORT  where the bridge listens (default: 127.0.0.1:7448)
  --run NAME          which run to join, where several share a network
  --name NAME         this actor's name, the same after a restart (default: node-PID)
  --envs E            environments to step together (default: what the learner asks for)`;

const NAME = /^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$/;

/** The checked configuration, or undefined if only help was asked for; throws with what is wrong. */
function config(): ActorConfig | undefined {
  const { values } = parseArgs({
    options: {
      bridge: { type: "string", default: "127.0.0.1:7448" },
      run: { type: "string", default: "*" },
      name: { type: "string", default: `node-${process.pid}` },
      envs: { type: "string" },
      help: { type: "boolean", default: false },
    },
  });
  if (values.help) return undefined;
  const [, host, port] = values.bridge.match(/^(.+):(\d{1,5})$/) ?? [];
  if (!host || Number(port) > 65535) throw new TypeError(`--bridge must be HOST:PORT, not ${values.bridge}`);
  if (!NAME.test(values.name)) throw new TypeError(`--name ${values.name} must be letters, digits, '.', '_' or '-'`);
  if (values.run !== "*" && !NAME.test(values.run)) throw new TypeError(`--run ${values.run} is no name`);
  const environments = values.envs === undefined ? undefined : Number(values.envs);
  if (environments !== undefined && !(Number.isInteger(environments) && environments >= 1 && environments <= 4096)) {
    throw new TypeError(`--envs must be from 1 to 4096, not ${values.envs}`);
  }
  const incarnation = randomBytes(8).readBigUInt64LE() >> 2n; // below 2^62
  return { host, port: Number(port), run: values.run, name: values.name, incarnation, environments };
}

async function main(): Promise<number> {
  let chosen: ActorConfig | undefined;
  try {
    chosen = config();
  } catch (error) {
    console.error(`node actor: ${(error as Error).message}`);
    return 2;
  }
  if (!chosen) {
    console.log(USAGE);
    return 0;
  }
  const { name } = chosen;
  const actor = new Actor(chosen, (text) => console.log(`actor ${name}: ${text}`));
  for (const signal of ["SIGTERM", "SIGINT"] as const) process.once(signal, () => actor.stop());
  try {
    await actor.run();
    return 0;
  } catch (error) {
    if (!(error instanceof RefusedError || error instanceof PolicyError || error instanceof ProtocolError)) throw error;
    console.error(`node actor: ${error.message}`);
    return 1;
  }
}

process.exitCode = await main();
