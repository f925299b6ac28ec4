"""Who may do what on a network that is not trusted: Zenoh's access control, by the names in certificates.

Denied is what is not allowed here. What comes over plain TCP is the machine's own: a router listens for that on
loopback only (transport/addresses.py). Pure functions.
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
    """What a certificate of that role bears as its common name: `learner`, `router`, `actor:NAME`, `operator:NAME`."""
    return f"{role}:{name}" if name else role


def access_control(actors: Iterable[str], operators: Iterable[str]) -> dict[str, Any]:
    """Zenoh's `access_control` for a router, embedded in a learner or not."""
    rules = [
        _rule("all", ("ingress", "egress"), _EVERYTHING, ["daedalus/**"]),
        *_actors_rules(),
        *_operators_rules(),
    ]
    subjects: list[dict[str, Any]] = [
        {"id": "ours", "cert_common_names": [common_name("learner"), common_name("router")]},
        {"id": "this machine", "link_protocols": ["tcp"]},
    ]
    policies: list[dict[str, Any]] = [{"rules": ["all"], "subjects": ["ours", "this machine"]}]
    shared = [rule["id"] for rule in _actors_rules()]
    for operator in sorted(operators):
        subjects.append({"id": f"operator {operator}", "cert_common_names": [common_name("operator", operator)]})
        policies.append({"rules": ["operators ask", "operators are told"], "subjects": [f"operator {operator}"]})
    for actor in sorted(actors):
        rules += _own_rules(actor)
        subjects.append({"id": f"actor {actor}", "cert_common_names": [common_name("actor", actor)]})
        own = [f"{actor} sends", f"{actor} is there", f"{actor} is answered"]
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
    """What every actor may do: ask to join, for programs and snapshots; follow snapshots; watch for the learner."""
    asked = [keys.join(_RUN), keys.program(_RUN, "*"), keys.snapshots(_RUN)]
    served = [*asked, keys.rollouts(_RUN, "*"), keys.evaluations(_RUN, "*")]
    return [
        _rule("actors ask", ["ingress"], ["query"], asked),
        _rule("actors are answered", ["egress"], ["reply"], asked),
        _rule("actors are told", ["egress"], ["declare_queryable"], served),
        _rule("actors follow", ["ingress"], ["declare_subscriber"], [keys.snapshots(_RUN)]),
        _rule("actors are pushed", ["egress"], ["put"], [keys.snapshots(_RUN)]),
        _rule("actors watch", ["ingress"], ["declare_liveliness_subscriber", "liveliness_query"], [keys.learner(_RUN)]),
        _rule("actors see", ["egress"], ["liveliness_token"], [keys.learner(_RUN)]),
    ]


def _own_rules(actor: str) -> list[dict[str, Any]]:
    """What one may do under its own name, and under `NAME.anything`: one certificate serves a host of actors."""
    names = [actor, f"{actor}.$*"]
    sent = [key for name in names for key in (keys.rollouts(_RUN, name), keys.evaluations(_RUN, name))]
    return [
        _rule(f"{actor} sends", ["ingress"], ["query"], sent),
        _rule(f"{actor} is answered", ["egress"], ["reply"], sent),
        _rule(
            f"{actor} is there", ["ingress"], ["liveliness_token"], [keys.presence(_RUN, name, "*") for name in names]
        ),
    ]


def _operators_rules() -> list[dict[str, Any]]:
    """Who looks after a run reads its status and sees who is there."""
    present = [keys.presence(_RUN, "*", "*"), keys.learner(_RUN)]
    return [
        _rule(
            "operators ask",
            ["ingress"],
            ["query", "declare_liveliness_subscriber", "liveliness_query"],
            [keys.status(_RUN), *present],
        ),
        _rule(
            "operators are told",
            ["egress"],
            ["reply", "declare_queryable", "liveliness_token"],
            [keys.status(_RUN), *present],
        ),
    ]
