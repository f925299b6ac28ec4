"""Rules of Zenoh's access control: what each role may do on an untrusted network, by the names in certificates.

Everything that these rules do not allow is denied. Plain TCP connections have full access: a router accepts them on
loopback only (transport/addresses.py). So have connections over a Unix socket. Pure functions.
"""

from collections.abc import Iterable
from typing import Any

from daedalus.protocol import keys

_RUN = "*"
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


def common_name(role: str, name: str = "") -> str:
    """Return the common name of a certificate: `learner`, `router`, `actor:NAME` or `operator:NAME`."""
    return f"{role}:{name}" if name else role


def access_control(actors: Iterable[str], operators: Iterable[str]) -> dict[str, Any]:
    """Return Zenoh's `access_control` setting for a router (or a learner, which embeds one).

    Args:
      actors, operators: authorised names.
    """
    rules = [
        _rule("all", ("ingress", "egress"), _EVERYTHING, ["daedalus/**"]),
        *_actors_rules(),
        *_operators_rules(),
    ]
    subjects: list[dict[str, Any]] = [
        {"id": "learner and routers", "cert_common_names": [common_name("learner"), common_name("router")]},
        {"id": "this machine", "link_protocols": ["tcp", "unixsock-stream"]},
    ]
    policies: list[dict[str, Any]] = [{"rules": ["all"], "subjects": ["learner and routers", "this machine"]}]
    shared = [rule["id"] for rule in _actors_rules()]
    for operator in sorted(operators):
        rules += _orders_rules(operator)
        subjects.append({"id": f"operator {operator}", "cert_common_names": [common_name("operator", operator)]})
        allowed = ["operators query", "operators receive", *(rule["id"] for rule in _orders_rules(operator))]
        policies.append({"rules": allowed, "subjects": [f"operator {operator}"]})
    for actor in sorted(actors):
        rules += _own_rules(actor)
        subjects.append({"id": f"actor {actor}", "cert_common_names": [common_name("actor", actor)]})
        own = [f"{actor} joins and uploads", f"{actor} is present", f"{actor} receives replies"]
        policies.append({"rules": [*shared, *own], "subjects": [f"actor {actor}"]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def _rule(name: str, flows: Iterable[str], messages: Iterable[str], key_expressions: list[str]) -> dict[str, Any]:
    return {
        "id": name,
        "permission": "allow",
        "flows": list(flows),
        "messages": list(messages),
        "key_exprs": key_expressions,
    }


def _actors_rules() -> list[dict[str, Any]]:
    """Return the rules of every actor: query programs and snapshots; subscribe; watch the learner."""
    queried = [keys.program(_RUN, "*"), keys.snapshots(_RUN)]
    published = [keys.snapshots(_RUN), keys.run_end(_RUN), keys.orders(keys.NO_RUN, "*")]
    served = [*queried, *_own_keys("*")]
    return [
        _rule("actors query", ["ingress"], ["query"], queried),
        _rule("actors receive replies", ["egress"], ["reply"], queried),
        _rule("actors discover queryables", ["egress"], ["declare_queryable"], served),
        _rule("actors subscribe", ["ingress"], ["declare_subscriber"], published),
        _rule("actors receive publications", ["egress"], ["put"], published),
        _rule(
            "actors watch the learner",
            ["ingress"],
            ["declare_liveliness_subscriber", "liveliness_query"],
            [keys.learner(_RUN)],
        ),
        _rule("actors see the learner", ["egress"], ["liveliness_token"], [keys.learner(_RUN)]),
    ]


def _own_keys(name: str) -> list[str]:
    """Return the keys of the queries that only the actor or evaluator `name` may send."""
    return [
        keys.join(_RUN, name),
        keys.rollouts(_RUN, name),
        keys.reports(_RUN, name),
        keys.evaluations(_RUN, name),
    ]


def _own_rules(actor: str) -> list[dict[str, Any]]:
    """Return the rules of one actor for its own name and for `NAME.anything`: one certificate serves a whole host."""
    names = [actor, f"{actor}.$*"]
    sent = [key for name in names for key in _own_keys(name)]
    return [
        _rule(f"{actor} joins and uploads", ["ingress"], ["query"], sent),
        _rule(f"{actor} receives replies", ["egress"], ["reply"], sent),
        _rule(
            f"{actor} is present", ["ingress"], ["liveliness_token"], [keys.presence(_RUN, name, "*") for name in names]
        ),
    ]


def _operators_rules() -> list[dict[str, Any]]:
    """Return the rules of every operator: query the status, and watch the presence."""
    present = [keys.presence(_RUN, "*", "*"), keys.learner(_RUN)]
    queried = [keys.status(_RUN)]
    return [
        _rule(
            "operators query",
            ["ingress"],
            ["query", "declare_liveliness_subscriber", "liveliness_query"],
            [*queried, *present],
        ),
        _rule(
            "operators receive",
            ["egress"],
            ["reply", "declare_queryable", "declare_subscriber", "liveliness_token"],
            [*queried, *present, keys.orders(_RUN, "*")],
        ),
    ]


def _orders_rules(operator: str) -> list[dict[str, Any]]:
    """Return the rules of one operator for orders, under its own name only: the name says who gave an order."""
    return [
        _rule(f"operator {operator} orders", ["ingress"], ["query"], [keys.orders(_RUN, operator)]),
        _rule(f"operator {operator} drains waiting actors", ["ingress"], ["put"], [keys.orders(keys.NO_RUN, operator)]),
    ]
