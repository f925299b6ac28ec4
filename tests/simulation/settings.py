"""What a seed decides: the run, the fleet, the network, and which faults happen."""

from dataclasses import dataclass
from random import Random

from daedalus.protocol.keys import ANY_RUN
from daedalus.protocol.spec import RunSpec

from . import codec
from .actors import ActorSettings
from .network import Weather

RUN = "r"
_MORE_ACTORS = 2  # may join later
FAULTS = (
    "kill actor",
    "stop actor",
    "freeze actor",
    "hang actor",
    "twin",
    "cut actor",
    "dead actor session",
    "flicker",
    "kill learner",
    "stop learner",
    "freeze learner",
    "cut learner",
    "hang learner",
    "dead learner session",
    "cut router",
    "new actor",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """One simulation, as drawn from its seed."""

    spec: RunSpec
    embedded: bool  # whether the learner is the router: if it ends, nobody reaches anybody
    preemption: float  # probability that a thread is interrupted at a lock
    weather: Weather  # before the network is healed
    faulty_seconds: float
    faults: tuple[tuple[float, str, float], ...]  # when, which, for how long
    actors: tuple[ActorSettings, ...]  # `_MORE_ACTORS` more than start
    train_seconds: float  # of one batch
    checkpoint_seconds: float
    ends_by: str  # finish or stop
    real_codec: bool  # whether messages are encoded
    poll_seconds: float  # how soon a waiting thread notices what nobody tells it
    patience_seconds: float  # after which a synchronous batch no longer waits for an actor
    fine: bool  # whether threads are interrupted at any line


def draw(seed: int) -> Settings:
    """Return the settings of a seed."""
    random = Random(seed)
    real_codec = random.random() < 0.05
    spec = _spec(random, message_bytes=1000 if real_codec else codec.SIZE)
    faulty = random.uniform(1.0, 12.0)
    collect = random.choice((0.1, 0.5, 1.0))
    poll = random.choice((0.2, 2.0, 2.0, 2.0))  # a long one shows a thread that should have been told
    return Settings(
        spec=spec,
        embedded=random.random() < 0.5,
        preemption=random.choice((0.0, 0.02, 0.1, 0.3)),
        weather=_weather(random),
        faulty_seconds=faulty,
        faults=_faults(random, faulty),
        actors=tuple(_actor(random, spec, collect, poll) for _ in range(spec.collection.actors + _MORE_ACTORS)),
        train_seconds=random.choice((0.0, 0.01, 0.1, 0.5)),
        checkpoint_seconds=random.choice((0.1, 0.1, 60.0)),
        ends_by=random.choice(("finish", "stop")),
        real_codec=real_codec,
        poll_seconds=poll,
        patience_seconds=random.choice((60.0, 3.0)),
        fine=random.random() < 0.03,
    )


def _actor(random: Random, spec: RunSpec, seconds: float, poll: float) -> ActorSettings:
    is_client = not spec.algorithm.synchronous and random.random() < 0.2
    return ActorSettings(
        kind="client" if is_client else "environments",
        link=random.choice(("lan", "lan", "lan", "wan", "auto")),
        run=random.choice((RUN, ANY_RUN)),
        collect_seconds=seconds * random.uniform(0.7, 1.3),
        poll_seconds=poll,
    )


def _spec(random: Random, message_bytes: int) -> RunSpec:
    actors = random.choice((1, 2, 2, 3))
    most = actors + _MORE_ACTORS
    algorithm = random.choice(("a2c", "a2c", "a3c", "impala", "appo"))
    window = random.randint(1, 4)
    training: dict[str, object] = {"algorithm": algorithm, "passes": 1, "minibatches": 2, "env_steps": 10**9}
    if algorithm in ("impala", "appo"):
        training["batch_rollouts"] = random.choice((None, 1, 2, 3))
    if algorithm != "a2c" and (random.random() < 0.5 or algorithm == "a3c"):
        # Large enough for every actor: where the learner is the bottleneck, all rollouts in flight wait in a queue. The
        # default of a3c does not count the actors that join later.
        training["max_policy_lag"] = random.choice((2, 4)) * most * window
    return RunSpec.model_validate(
        {
            "environment": {"id": "simulated"},
            "collection": {"actors": actors, "envs_per_actor": 1, "rollout_length": 1, "window": window},
            "training": training,
            "service": {"queue_megabytes": random.choice((64.0, 2 * most * message_bytes / 2**20))},
        }
    )


def _weather(random: Random) -> Weather:
    """Return the network's behaviour; each kind of fault is absent in about half of the seeds."""

    def perhaps(*values: float) -> float:
        return random.choice(values) if random.random() < 0.5 else 0.0

    return Weather(
        delay=random.choice((0.001, 0.02, 0.1)),
        slow=perhaps(0.02, 0.2),
        slow_seconds=random.choice((0.5, 3.0, 3.0)),
        lost=perhaps(0.02, 0.1, 0.3),
        noticed=random.choice((0.0, 0.5, 1.0)),
        duplicated=perhaps(0.1, 0.5),
        refused=perhaps(0.2),
        lease=random.choice((0.0, 1.0, 10.0)),
    )


def _faults(random: Random, seconds: float) -> tuple[tuple[float, str, float], ...]:
    kinds = random.sample(FAULTS, random.randint(1, 4))
    if random.random() < 0.4:
        kinds.append(random.choice(("kill learner", "stop learner", "twin")))
    count = random.choice((0, 1, 2, 4, 8))
    drawn = [
        (random.uniform(0.0, seconds), random.choice(kinds), random.choice((0.1, 1.0, 5.0, 12.0))) for _ in range(count)
    ]
    return tuple(sorted(drawn))
