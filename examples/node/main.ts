/** The command line of the actor: see `node main.ts --help`. */

import { randomBytes } from "node:crypto";
import { parseArgs } from "node:util";
import { Actor, type ActorConfig } from "./actor.ts";
import { RefusedError } from "./link.ts";
import { PolicyError } from "./policy.ts";
import { ProtocolError } from "./wire.ts";

const USAGE = `\
usage: node main.ts [--gateway HOST:PORT] [--run NAME] [--name NAME] [--envs E]

Collect rollouts for a learner, through \`daedalus gateway\`.

  --gateway HOST:PORT  address of the gateway (default: 127.0.0.1:8080)
  --run NAME          the run to join; required if several learners share a network
  --name NAME         name of this actor, the same after a restart (default: node-PID)
  --envs E            number of environments (default: the learner's envs_per_actor)

exit status: 0 the run is over or a signal arrived, 1 failed, 2 bad usage`;

const NAME = /^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$/;
const NAME_RULE = "must have 1 to 64 letters, digits, '.', '_' or '-', and start with a letter or a digit";

/** Return the checked configuration, or undefined after --help. Throws TypeError for an invalid option. */
function parseOptions(): ActorConfig | undefined {
  const { values } = parseArgs({
    options: {
      gateway: { type: "string", default: "127.0.0.1:8080" },
      run: { type: "string", default: "*" },
      name: { type: "string", default: `node-${process.pid}` },
      envs: { type: "string" },
      help: { type: "boolean", default: false },
    },
  });
  if (values.help) return undefined;
  const [, host, port] = values.gateway.match(/^(.+):(\d{1,5})$/) ?? [];
  if (!host || Number(port) > 65535) throw new TypeError(`--gateway must be HOST:PORT, not ${values.gateway}`);
  if (!NAME.test(values.name)) throw new TypeError(`--name ${NAME_RULE}, not ${values.name}`);
  if (values.run !== "*" && !NAME.test(values.run)) throw new TypeError(`--run ${NAME_RULE}, not ${values.run}`);
  const environments = values.envs === undefined ? undefined : Number(values.envs);
  if (environments !== undefined && !(Number.isInteger(environments) && environments >= 1 && environments <= 4096)) {
    throw new TypeError(`--envs must be from 1 to 4096, not ${values.envs}`);
  }
  const incarnation = randomBytes(8).readBigUInt64LE() >> 2n; // below 2^62
  return { host, port: Number(port), run: values.run, name: values.name, incarnation, environments };
}

async function main(): Promise<number> {
  let config: ActorConfig | undefined;
  try {
    config = parseOptions();
  } catch (error) {
    console.error(`node actor: ${(error as Error).message}`);
    return 2;
  }
  if (!config) {
    console.log(USAGE);
    return 0;
  }
  const { name } = config;
  const actor = new Actor(config, (text) => console.log(`actor ${name}: ${text}`));
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
