"""Actor without a learner: collects and encodes rollouts of Pong in one thread until its standard input ends.

    python -m benchmarks.busy_actor --encoder nature

Prints "busy" when it starts to play, and at the end its env_steps, and the elapsed and the CPU
seconds that they took. Every half second there are other weights, the
same for all such actors of the machine. Part of learner_speed.py and shared_inference.py.
"""

import argparse
import threading
import time

from daedalus.actor.collecting.environment_collector import EnvironmentCollector
from daedalus.launch.process_lifecycle import exit_with_parent
from daedalus.learner.run.settings import override, read_preset, run_spec
from daedalus.policy.acting.program import export_program
from daedalus.policy.acting.runtime import OnnxRuntime, PolicyRuntime
from daedalus.policy.acting.shared_runtime import SharedRuntime
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.protocol.codec import encode
from daedalus.protocol.messages import Snapshot
from daedalus.protocol.uploads import RolloutIdentity

_UPDATE_SECONDS = 0.5


def main() -> None:
    options = argparse.ArgumentParser()
    options.add_argument("--encoder", default="small")
    options.add_argument("--inference-at")
    options.add_argument("--runtime", choices=("onnx", "torch"), default="onnx")
    parsed = options.parse_args()
    over = threading.Event()
    exit_with_parent(over)
    settings = read_preset("pong")
    changes = ("environment.backend=ale", "collection.rollout_length=16", f"policy.encoder={parsed.encoder}")
    override(settings, changes)
    spec = run_spec(settings)
    collector = EnvironmentCollector()
    try:
        spaces, _ = collector.prepare(spec.for_actors())
        network = ActorCritic(spec.policy, spaces)
        first = {name: parameter.detach().numpy() for name, parameter in network.named_parameters()}
        program = export_program(network, spaces)
        runtime: PolicyRuntime
        if parsed.inference_at is None:
            runtime = OnnxRuntime(program)
        else:
            learning = spec.for_actors().learning_settings.model_dump(mode="json")
            setup = {"learning": learning, "spaces": spaces.model_dump(mode="json")}
            runtime = SharedRuntime(
                parsed.inference_at, setup, program if parsed.runtime == "onnx" else b"", spaces, over
            )
        collector.begin(runtime, spec.for_actors(), seed=1)
        sequence = env_steps = version = 0
        began = began_cpu = 0.0
        while not over.is_set():
            newest = int(time.monotonic() / _UPDATE_SECONDS)
            if newest != version:
                version = newest
                weights = {name: values + values.dtype.type(1e-6 * (version % 1000)) for name, values in first.items()}
                collector.load(Snapshot(learner_epoch=1, policy_version=version, program="", weights=weights))
            identity = RolloutIdentity(actor="busy", incarnation=1, sequence=sequence, learner_epoch=1)
            rollout = collector.collect(identity)
            encode(rollout)
            if sequence:
                env_steps += rollout.env_steps
            else:
                print("busy", flush=True)
                began, began_cpu = time.monotonic(), time.process_time()
            sequence += 1
        print(env_steps, time.monotonic() - began, time.process_time() - began_cpu, flush=True)
    finally:
        collector.close()


if __name__ == "__main__":
    main()
