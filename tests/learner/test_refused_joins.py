"""learner/serving/fleet.py: bounded, with one entry for each host and reason."""

from daedalus.learner.serving.fleet import RefusedJoins
from daedalus.protocol.messages import Origin

HERE = Origin(host="arm-box", software="daedalus-rl 1.0", address="tcp/10.0.0.7:1")


def test_restarts_of_an_actor_are_one_entry_with_a_count() -> None:
    refused = RefusedJoins()
    refused.add("arm-box-101", HERE, "no module", 0.0)
    refused.add("arm-box-102", HERE, "no module", 5.0)
    refused.add("arm-box-103", HERE, "other spaces", 6.0)
    first, second = refused.report(8.0)
    assert (first.actor, first.host, first.software, first.count) == ("arm-box-102", "arm-box", "daedalus-rl 1.0", 2)
    assert (first.reason, first.seconds_since_last) == ("no module", 3.0)
    assert second.reason == "other spaces"


def test_actors_of_unknown_hosts_are_told_apart_by_name() -> None:
    refused = RefusedJoins()
    for name in ("a", "b"):
        refused.add(name, Origin(), "protocol version 5", 0.0)
    assert [each.actor for each in refused.report(0.0)] == ["a", "b"]


def test_entry_leaves_when_its_actor_has_joined_or_after_an_hour() -> None:
    refused = RefusedJoins()
    for name, now in (("a", 0.0), ("b", 0.0), ("c", 2000.0)):
        refused.add(name, Origin(), "name in use", now)
    refused.joined("a")
    assert [each.actor for each in refused.report(3600.0)] == ["b", "c"]
    assert [each.actor for each in refused.report(3601.0)] == ["c"]


def test_table_is_bounded_and_one_owner_does_not_push_out_the_others() -> None:
    refused = RefusedJoins()
    refused.add("honest", HERE, "no module", 0.0)
    for number in range(1000):
        refused.add(f"evil.{number}", Origin(host=f"h{number}"), f"reason {number}", 1.0)
    report = refused.report(1.0)
    assert len(report) == 32
    assert report[0].actor == "honest"
    assert report[-1].actor == "evil.999"


def test_long_texts_are_cut() -> None:
    refused = RefusedJoins()
    long = "x" * 5000
    refused.add(long, Origin(host=long, software=long, address=long), long, 0.0)
    (entry,) = refused.report(0.0)
    assert (len(entry.actor), len(entry.host), len(entry.software), len(entry.reason)) == (64, 64, 64, 300)
