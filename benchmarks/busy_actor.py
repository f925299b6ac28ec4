"""Actor without a learner: collects and encodes rollouts of Pong in one thread until its standard input ends.

Prints "busy" when it starts to play. Part of learner_speed.py.
"""

import threading

from daedalus.actor.collecting.environment_collector import EnvironmentCollector
from daedalus.launch.process_lifecycle import exit_with_parent
from daedalus.learner.run.settings import override, read_preset, run_spec
from daedalus.policy.acting.program import export_program
from daedalus.policy.acting.runtime import OnnxRuntime
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.protocol.codec import encode
from daedalus.protocol.messages import Snapshot
from daedalus.protocol.uploads import RolloutIdentity


def main() -> None:
    over = threading.Event()
    exit_with_parent(over)
    settings = read_preset("pong")
    override(settings, ("environment.backend=ale", "collection.rollout_length=16"))
    spec = run_spec(settings)
    collector = EnvironmentCollector()
    try:
        spaces, _ = collector.prepare(spec.for_actors())
        network = ActorCritic(spec.policy, spaces)
        weights = {name: parameter.detach().numpy() for name, parameter in network.named_parameters()}
        collector.begin(OnnxRuntime(export_program(network, spaces)), spec.for_actors(), seed=1)
        collector.load(Snapshot(learner_epoch=1, policy_version=0, program="", weights=weights))
        sequence = 0
        print("busy", flush=True)
        while not over.is_set():
            identity = RolloutIdentity(actor="busy", incarnation=1, sequence=sequence, learner_epoch=1)
            encode(collector.collect(identity))
            sequence += 1
    finally:
        collector.close()


if __name__ == "__main__":
    main()
