"""Actor without a learner: collects and encodes rollouts of Pong in one thread until its standard input ends.

Prints "busy" when it starts to play. Part of learner_speed.py.
"""

import threading

from daedalus.actor.collecting.collector import Collector
from daedalus.actor.environments.make import make_environments
from daedalus.cli.processes import exit_with_parent
from daedalus.learner.run.settings import read_preset, run_spec
from daedalus.policy.acting.program import export_program
from daedalus.policy.acting.runtime import OnnxRuntime
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.protocol.codec import encode
from daedalus.protocol.messages import RolloutIdentity


def main() -> None:
    over = threading.Event()
    exit_with_parent(over)
    spec = run_spec(read_preset("pong"))
    environments = make_environments(
        spec.environment.model_copy(update={"backend": "ale"}), spec.collection.envs_per_actor
    )
    try:
        network = ActorCritic(spec.policy, environments.spaces)
        runtime = OnnxRuntime(export_program(network, environments.spaces.observation))
        runtime.load({name: parameter.detach().numpy() for name, parameter in network.named_parameters()})
        collector = Collector(environments, runtime, spec.environment, rollout_length=16, seed=1)
        sequence = 0
        print("busy", flush=True)
        while not over.is_set():
            identity = RolloutIdentity(actor="busy", incarnation=1, sequence=sequence, learner_epoch=1)
            encode(collector.collect(identity, policy_version=0))
            sequence += 1
    finally:
        environments.close()


if __name__ == "__main__":
    main()
