"""Functions that return every key expression. All keys are under `daedalus/{run}/`."""

import hashlib
import re
from collections import Counter
from collections.abc import Iterable

from daedalus.protocol.texts import MAX_NAME

_NAME = re.compile(rf"[A-Za-z0-9][A-Za-z0-9._-]{{0,{MAX_NAME - 1}}}")
_KEPT, _DIGEST = 55, 8  # characters of a name that is made from a text, which is no name itself
_MAX_SHOWN = 80  # characters of an invalid name, which may come from a peer

ANY_RUN = "*"
NO_RUN = "-"  # in place of a run: actors that wait for one. No run has this name
NO_OPERATOR = "-"  # in place of an operator's name: a process without an operator's certificate. No operator has it


def is_name(name: str) -> bool:
    """Return whether `name` can be one chunk of a key."""
    return _NAME.fullmatch(name) is not None


def check_name(name: str, what: str) -> str:
    """Return `name` if it can be one chunk of a key. Raises ValueError, which names `what` it is, otherwise."""
    if not is_name(name):
        raise ValueError(
            f"{what} {name[:_MAX_SHOWN]!r} must be 1 to 64 letters, digits, '.', '_' or '-', starting with a letter or "
            "digit"
        )
    return name


def as_name(text: str) -> str:
    """Return a text that can be one chunk of a key: `text` itself, or what is left of it with a digest of the whole."""
    if is_name(text):
        return text
    kept = re.sub(r"[^A-Za-z0-9._-]+", "-", text).lstrip("._-")[:_KEPT].rstrip("._-")
    digest = hashlib.sha256(text.encode(errors="backslashreplace")).hexdigest()[:_DIGEST]
    return f"{kept or 'run'}-{digest}"


def join(run: str, actor: str) -> str:
    """Return the key of the queries by which an actor joins (`*` for all actors)."""
    return f"daedalus/{run}/join/{actor}"


def program(run: str, program_hash: str) -> str:
    """Return the key of queries for one policy program (`*` for all)."""
    return f"daedalus/{run}/program/{program_hash}"


def rollouts(run: str, actor: str) -> str:
    """Return the key of one actor's rollouts (`*` for all actors)."""
    return f"daedalus/{run}/rollouts/{actor}"


def reports(run: str, actor: str) -> str:
    """Return the key of the reports of one client about itself (`*` for all)."""
    return f"daedalus/{run}/reports/{actor}"


def evaluations(run: str, evaluator: str) -> str:
    """Return the key of one evaluator's requests and reports (`*` for all evaluators)."""
    return f"daedalus/{run}/evaluations/{evaluator}"


def snapshots(run: str) -> str:
    """Return the key where snapshots are published, and where the newest is queried."""
    return f"daedalus/{run}/snapshots"


def run_end(run: str) -> str:
    """Return the key where the learner publishes that it ends."""
    return f"daedalus/{run}/end"


def orders(run: str, operator: str) -> str:
    """Return the key of one operator's orders (`*` for all operators): queries to the learner of a run.

    With NO_RUN they are publications to the actors that wait for a run.
    """
    return f"daedalus/{run}/orders/{operator}"


def presence(run: str, actor: str, incarnation: int | str) -> str:
    """Return the liveliness token of one incarnation of an actor (`*` for all); NO_RUN: while it waits for a run."""
    return f"daedalus/{run}/actors/{actor}/{incarnation}"


def parse_presence(key: str) -> tuple[str, int] | None:
    """Return the actor's name and incarnation in a presence key, or None if the key is malformed."""
    actor, incarnation = key.split("/")[-2:]
    return (actor, int(incarnation)) if re.fullmatch(r"[0-9]{1,19}", incarnation) else None


def learner(run: str) -> str:
    """Return the liveliness token of the learner."""
    return f"daedalus/{run}/learner"


def status(run: str) -> str:
    """Return the key of queries for the status."""
    return f"daedalus/{run}/status"


def intersection(served: str, queried: str) -> str:
    """Return the key of a query to a server: where the query has `*`, the chunk that is served.

    Where both have `*`, it stays. A query with `**`, which nobody of ours sends, has the served key.
    """
    if "*" not in queried:
        return queried
    ours, theirs = served.split("/"), queried.split("/")
    if len(ours) != len(theirs):
        return served
    return "/".join(mine if "*" in other else other for mine, other in zip(ours, theirs, strict=True))


def last_chunk(key: str) -> str:
    """Return the last chunk of a key: the name of the actor or evaluator."""
    return key.rsplit("/", 1)[-1]


def owner(name: str) -> str:
    """Return the part of a name before the first dot: a certificate for NAME serves NAME and NAME.anything."""
    return name.split(".", 1)[0]


def first_of_largest_owner(names: Iterable[str]) -> str:
    """Return the first of the names of the owner that has the most.

    Where room is limited, this name makes room for another: no owner can then push out the others.
    """
    names = list(names)
    largest = Counter(map(owner, names)).most_common(1)[0][0]
    return next(name for name in names if owner(name) == largest)
