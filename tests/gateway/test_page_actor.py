"""gateway/page/actor.js in Node: the next call raises the end of the run, although none waited when it came."""

import subprocess
from collections.abc import Callable
from pathlib import Path

import node
import pytest
from gateways import RunningGateway
from processes import LIMIT
from scripted_learner import ScriptedLearner

from daedalus.gateway import client_gateway as gateway_module
from daedalus.protocol import keys
from daedalus.protocol.codec import encode
from daedalus.protocol.messages import RunEnded
from daedalus.transport.memory import MemoryNetwork

ACTOR = Path(gateway_module.__file__).parent / "page" / "actor.js"
SCRIPT = """
const closed = new Promise((resolve) => {
  globalThis.WebSocket = class extends WebSocket {
    constructor(address) {
      super(address);
      this.addEventListener("close", () => setTimeout(resolve));
    }
  };
});
const { Actor } = await import(process.argv[1]);
const actor = new Actor(process.argv[2]);
await actor.join("page");
await actor.act([0, 0, 0, 0]);
console.log("acted");
await closed; // between two steps
for (let attempt = 0; attempt < 2; attempt++) {
  const error = await actor.act([0, 0, 0, 0], 1).catch((error) => error);
  console.log(`${error.constructor.name}: ${error.message}`);
}
"""


def finish(learner: ScriptedLearner, gateway: RunningGateway) -> None:
    message = RunEnded(learner_epoch=1, outcome="finished", reason="solved")
    learner.transport.publish(keys.run_end("r"), encode(message))


def stop(learner: ScriptedLearner, gateway: RunningGateway) -> None:
    gateway.close()


@pytest.mark.parametrize(
    ("end", "error"),
    [
        (finish, "RefusedError: the run is over: solved"),
        (stop, "Error: the connection to the gateway ended"),
    ],
)
def test_actor_is_told_between_two_steps_that_no_answer_comes(
    network: MemoryNetwork,
    learner: ScriptedLearner,
    end: Callable[[ScriptedLearner, RunningGateway], None],
    error: str,
) -> None:
    program = node.executable((22, 0), "WebSockets")
    gateway = RunningGateway(network)
    command = [program, "--input-type=module", "-e", SCRIPT, ACTOR.as_uri(), f"ws://127.0.0.1:{gateway.port}/actor"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "acted\n"
        end(learner, gateway)
        output, _ = process.communicate(timeout=LIMIT)
        assert output.splitlines() == [error, error]
    finally:
        process.kill()
        process.wait()
        if end is not stop:
            gateway.close()
