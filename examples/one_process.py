"""A learner and an actor in one process, over the transport in memory: `python examples/one_process.py`.

The same two services as in a fleet, without sockets and without child processes.
"""

import sys
import tempfile
import threading
from pathlib import Path

import daedalus
from daedalus.actor.session.actor_config import ActorConfig
from daedalus.actor.session.actor_service import ActorService
from daedalus.learner.reporting.progress import Progress
from daedalus.learner.run.run_directory import SUMMARY, create, read_json
from daedalus.learner.run.settings import choose_algorithm, override, read_preset, run_spec
from daedalus.learner.service import LearnerService, Outputs
from daedalus.learner.serving.run_context import RunContext
from daedalus.protocol.spec import RunSpec
from daedalus.transport.memory import MemoryNetwork, MemoryTransport


def play(network: MemoryNetwork, stop: threading.Event) -> None:
    """Run the actor: it gets the environment and the policy from the learner and streams rollouts to it."""
    transport = MemoryTransport(network)
    try:
        ActorService(ActorConfig(name="actor-0", incarnation=1), transport, stop).run()
    finally:
        transport.close()


def learn(spec: RunSpec, directory: Path, network: MemoryNetwork, stop: threading.Event) -> None:
    """Run the learner: it takes rollouts, updates the network and publishes snapshots until the target is reached."""
    transport = MemoryTransport(network)
    progress = Progress(sys.stdout, spec.training.env_steps)
    try:
        context = RunContext.begin(directory, spec, stop)
        LearnerService(context, transport, Outputs(progress=progress)).run()
    finally:
        transport.close()


def main() -> None:
    settings = read_preset("cartpole")
    choose_algorithm(settings, "impala")
    override(settings, ["collection.actors=1", "training.target_return=200"])
    spec, directory = run_spec(settings), Path(tempfile.mkdtemp()) / "run"
    create(directory, spec)
    network, stop = MemoryNetwork(), threading.Event()
    actor = threading.Thread(target=play, args=(network, stop))
    actor.start()
    try:
        learn(spec, directory, network, stop)
    finally:
        stop.set()
        actor.join()
    print(f"mean return {read_json(directory / SUMMARY)['episode_return_mean']:.0f}")
    print(f"policy version {daedalus.load_policy(directory).policy_version} is in {directory}")


if __name__ == "__main__":
    main()
