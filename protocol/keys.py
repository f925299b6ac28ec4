"""Every key expression, as a function. All of them live under `daedalus/{run}/`."""

import re

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")

ANY_RUN = "*"


def check_name(name: str, what: str) -> str:
    """Returns `name` if it can be one chunk of a key; raises ValueError, naming `what` it is, if not."""
    if not _NAME.fullmatch(name):
        raise ValueError(
            f"{what} {name!r} must be 1 to 64 letters, digits, '.', '_' or '-', starting with a letter or digit"
        )
    return name


def join(run: str) -> str:
    """Where actors ask to take part."""
    return f"daedalus/{run}/join"


def program(run: str, program_hash: str) -> str:
    """Where one policy program is asked for (`*` for all of them)."""
    return f"daedalus/{run}/program/{program_hash}"


def rollouts(run: str, actor: str) -> str:
    """Where one actor's rollouts go (`*` for all of them)."""
    return f"daedalus/{run}/rollouts/{actor}"


def evaluations(run: str, evaluator: str) -> str:
    """Where one evaluator asks for policies and reports on them (`*` for all of them)."""
    return f"daedalus/{run}/evaluations/{evaluator}"


def snapshots(run: str) -> str:
    """Where weights are published, and the newest asked for."""
    return f"daedalus/{run}/snapshots"


def presence(run: str, actor: str, incarnation: int | str) -> str:
    """The liveliness token of one life of an actor (`*` for all of them)."""
    return f"daedalus/{run}/actors/{actor}/{incarnation}"


def parse_presence(key: str) -> tuple[str, int] | None:
    """The actor's name and incarnation in a presence key; None if it is not one that an actor of ours has."""
    actor, incarnation = key.split("/")[-2:]
    return (actor, int(incarnation)) if re.fullmatch(r"[0-9]{1,19}", incarnation) else None


def learner(run: str) -> str:
    """The liveliness token of the learner."""
    return f"daedalus/{run}/learner"


def status(run: str) -> str:
    """Where the fleet's status is asked for."""
    return f"daedalus/{run}/status"


def last_chunk(key: str) -> str:
    """The actor's name in a rollouts key, the evaluator's in an evaluations key."""
    return key.rsplit("/", 1)[-1]
