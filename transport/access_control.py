"""Rules of Zenoh's access control: what each role may do on an untrusted network, by the names in certificates.

Everything that these rules do not allow is denied. Plain TCP connections have full access: a router accepts them on
loopback only (transport/addresses.py). So have connections over a Unix socket. Pure functions.
"""

from collections.abc import Callable, Iterable
from typing import Any

from daedalus.protocol import keys

_BOTH = ("ingress", "egress")
_EVERYTHING = (
    "put",
    "delete",
    "declare_subscriber",
    "query",
    "reply",
    "declare_queryable",
    "liveliness_token",
    "liveliness_query",
    "declare_liveliness_subscriber",
)


def common_name(role: str, name: str = "", run: str = "") -> str:
    """Return the common name of a certificate.

    It is `router`, `learner`, `actor:NAME` or `operator:NAME`, with `@RUN` after the name if the certificate is for the
    runs RUN and RUN.anything only. A learner for these runs only has no other name: `learner:RUN`.
    """
    if role == "learner":
        return f"{role}:{run}" if run else role
    return f"{role}:{name}{f'@{run}' if run else ''}" if name else role


def parse_common_name(text: str) -> tuple[str, str, str]:
    """Return the role, the name and the run in a common name; an empty text for what it does not have."""
    role, _, name = text.partition(":")
    if role == "learner":
        return role, "", name
    name, _, run = name.partition("@")
    return role, name, run


def access_control(clients: Iterable[str]) -> dict[str, Any]:
    """Return Zenoh's `access_control` setting for a router (or a learner, which embeds one).

    Args:
      clients: authorised common names of actors, operators, and learners of certain runs.
    """
    identities = sorted({(*parse_common_name(client), client) for client in clients})
    rules = [_rule("all", _BOTH, _EVERYTHING, ["daedalus/**"])]
    subjects: list[dict[str, Any]] = [
        {"id": "learner and routers", "cert_common_names": [common_name("learner"), common_name("router")]},
        {"id": "this machine", "link_protocols": ["tcp", "unixsock-stream"]},
    ]
    policies: list[dict[str, Any]] = [{"rules": ["all"], "subjects": ["learner and routers", "this machine"]}]
    shared: dict[tuple[str, str], list[dict[str, Any]]] = {}  # by role and run
    for role, name, run, client in identities:
        of_all, of_one = _RULES[role]
        if (role, run) not in shared:
            shared[role, run] = of_all(run)
            rules += shared[role, run]
        own = of_one(name, run)
        rules += own
        subjects.append({"id": client, "cert_common_names": [client]})
        policies.append({"rules": [rule["id"] for rule in (*shared[role, run], *own)], "subjects": [client]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def _chunks(run: str) -> list[str]:
    """Return the runs that a certificate is for, as chunks of keys: all, or `run` and those whose names begin so."""
    return [run, f"{run}.$*"] if run else ["*"]


def _suffix(run: str) -> str:
    return f" of {run}" if run else ""


def _learner_rules(run: str) -> list[dict[str, Any]]:
    """Return the rules of a learner of certain runs: everything in these runs.

    It also receives queries to all runs at once; Zenoh passes on what fits a queryable that it could declare.
    """
    return [
        _rule(f"everything{_suffix(run)}", _BOTH, _EVERYTHING, [f"daedalus/{each}/**" for each in _chunks(run)]),
        _rule(f"queries to all runs{_suffix(run)}", ["egress"], ["query"], ["daedalus/**"]),
    ]


def _rule(name: str, flows: Iterable[str], messages: Iterable[str], key_expressions: list[str]) -> dict[str, Any]:
    return {
        "id": name,
        "permission": "allow",
        "flows": list(flows),
        "messages": list(messages),
        "key_exprs": key_expressions,
    }


def _actors_rules(run: str) -> list[dict[str, Any]]:
    """Return the rules of every actor of some runs: query programs and snapshots; subscribe; watch the learner."""
    queried = [key for each in _chunks(run) for key in (keys.program(each, "*"), keys.snapshots(each))]
    published = [key for each in _chunks(run) for key in (keys.snapshots(each), keys.run_end(each))]
    published += [] if run else [keys.orders(keys.NO_RUN, "*")]  # whoever drains waiting actors is of no run
    served = [*queried, *_own_keys("*", run)]
    learners = [keys.learner(each) for each in _chunks(run)]
    watching = ["declare_liveliness_subscriber", "liveliness_query"]
    suffix = _suffix(run)
    return [
        _rule(f"actors{suffix} query", ["ingress"], ["query"], queried),
        _rule(f"actors{suffix} receive replies", ["egress"], ["reply"], queried),
        _rule(f"actors{suffix} discover queryables", ["egress"], ["declare_queryable"], served),
        _rule(f"actors{suffix} subscribe", ["ingress"], ["declare_subscriber"], published),
        _rule(f"actors{suffix} receive publications", ["egress"], ["put"], published),
        _rule(f"actors{suffix} watch the learner", ["ingress"], watching, learners),
        _rule(f"actors{suffix} see the learner", ["egress"], ["liveliness_token"], learners),
    ]


def _own_keys(name: str, run: str) -> list[str]:
    """Return the keys of the queries that only the actor or evaluator `name` may send."""
    kinds = (keys.join, keys.rollouts, keys.reports, keys.evaluations)
    return [key(each, name) for each in _chunks(run) for key in kinds]


def _own_rules(actor: str, run: str) -> list[dict[str, Any]]:
    """Return the rules of one actor for its own name and for `NAME.anything`: one certificate serves a whole host."""
    names = [actor, f"{actor}.$*"]
    sent = [key for name in names for key in _own_keys(name, run)]
    present = [keys.presence(each, name, "*") for each in _chunks(run) for name in names]
    return [
        _rule(f"{actor}{_suffix(run)} joins and uploads", ["ingress"], ["query"], sent),
        _rule(f"{actor}{_suffix(run)} receives replies", ["egress"], ["reply"], sent),
        _rule(f"{actor}{_suffix(run)} is present", ["ingress"], ["liveliness_token"], present),
    ]


def _operators_rules(run: str) -> list[dict[str, Any]]:
    """Return the rules of every operator of some runs: query the status, and watch the presence."""
    present = [key for each in _chunks(run) for key in (keys.presence(each, "*", "*"), keys.learner(each))]
    queried = [keys.status(each) for each in _chunks(run)]
    return [
        _rule(
            f"operators{_suffix(run)} query",
            ["ingress"],
            ["query", "declare_liveliness_subscriber", "liveliness_query"],
            [*queried, *present],
        ),
        _rule(
            f"operators{_suffix(run)} receive",
            ["egress"],
            ["reply", "declare_queryable", "declare_subscriber", "liveliness_token"],
            [*queried, *present, *(keys.orders(each, "*") for each in _chunks(run))],
        ),
    ]


def _orders_rules(operator: str, run: str) -> list[dict[str, Any]]:
    """Return the rules of one operator for orders, under its own name only: the name says who gave an order."""
    rule, ordered = f"operator {operator}{_suffix(run)}", [keys.orders(each, operator) for each in _chunks(run)]
    orders = [_rule(f"{rule} orders", ["ingress"], ["query"], ordered)]
    if not run:  # actors that wait are of no run
        waiting = [keys.orders(keys.NO_RUN, operator)]
        orders.append(_rule(f"{rule} drains waiting actors", ["ingress"], ["put"], waiting))
    return orders


# By role: the rules of all of a run, and those of one of them.
_RULES: dict[str, tuple[Callable[[str], list[dict[str, Any]]], Callable[[str, str], list[dict[str, Any]]]]] = {
    "actor": (_actors_rules, _own_rules),
    "operator": (_operators_rules, _orders_rules),
    "learner": (_learner_rules, lambda _name, _run: []),
}
