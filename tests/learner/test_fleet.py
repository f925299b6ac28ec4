"""learner/serving/fleet.py: joins, presence, incarnations and sequence numbers, and refused joins."""

import pytest
from building import SPACES, identity, joined_fleet

from daedalus.learner.serving import fleet as fleet_module
from daedalus.learner.serving import query_responses
from daedalus.learner.serving.fleet import Fleet
from daedalus.learner.serving.refused_joins import RefusedJoins
from daedalus.protocol.messages import PAGE_ACTORS, Join, Origin, Refusal
from daedalus.protocol.spaces import ArraySpace, DiscreteSpace, ObservationSpaces, Spaces

WINDOW = 1024
MINUTE = 60.0


def attempt(fleet: Fleet, name: str, incarnation: int = 1, now: float = 0.0) -> Refusal | None:
    """Let an incarnation join with spaces."""
    return fleet.join(Join(actor=name, incarnation=incarnation, spaces=SPACES, environments=3), now)


# --------------------------------------------------------------------------------------------- joining

OTHER = Spaces(
    observations={"observation": ArraySpace(shape=(5,), dtype="uint8")}, actions={"action": DiscreteSpace(counts=(2,))}
)


def test_join_without_spaces_changes_nothing() -> None:
    fleet = Fleet(1, None)
    assert fleet.join(Join(actor="a", incarnation=1), 0.0) is None
    assert (fleet.spaces, fleet.actors) == (None, {})
    fleet.join(Join(actor="a", incarnation=1, spaces=SPACES, environments=2), 3.0)
    assert fleet.join(Join(actor="a", incarnation=2), 9.0) is None
    actor = fleet.actors["a"]
    assert (actor.incarnation, actor.incarnations, actor.last_seen, actor.environments) == (1, 1, 3.0, 2)


def test_first_join_with_spaces_sets_the_spaces_of_the_run() -> None:
    fleet = Fleet(1, None)
    assert fleet.join(Join(actor="a", incarnation=1, spaces=SPACES, environments=2), 0.0) is None
    assert fleet.spaces == SPACES


def test_components_of_the_run_stay_in_their_order() -> None:
    """The weights of a checkpoint depend on it."""
    both: ObservationSpaces = {
        "a": ArraySpace(shape=(2,), dtype="float32"),
        "b": ArraySpace(shape=(2,), dtype="float32"),
    }
    spaces, reversed_ones = (
        Spaces(observations=each, actions=SPACES.actions) for each in (both, dict([*both.items()][::-1]))
    )
    fleet = Fleet(1, spaces)
    assert fleet.join(Join(actor="a", incarnation=1, spaces=reversed_ones, environments=1), 0.0) is None
    assert fleet.spaces is not None
    assert [*fleet.spaces.observations] == ["a", "b"]


def test_join_with_other_spaces_is_refused_with_both_spaces_named() -> None:
    fleet = joined_fleet("a")
    refusal = fleet.join(Join(actor="b", incarnation=1, spaces=OTHER, environments=1), 0.0)
    assert refusal is not None
    assert refusal.code == "mismatch"
    assert str(OTHER) in refusal.reason
    assert str(SPACES) in refusal.reason
    assert fleet.spaces == SPACES
    assert "b" not in fleet.actors


def test_join_with_other_spaces_than_the_checkpoint_is_refused() -> None:
    refusal = Fleet(1, SPACES).join(Join(actor="a", incarnation=1, spaces=OTHER, environments=1), 0.0)
    assert refusal is not None
    assert refusal.code == "mismatch"


def test_join_with_number_of_environments_out_of_range_is_refused() -> None:
    for environments in (0, 4097, 2**62):
        fleet = Fleet(1, None)
        refusal = fleet.join(Join(actor="a", incarnation=1, spaces=SPACES, environments=environments), 0.0)
        assert refusal is not None
        assert refusal.code == "malformed"
        assert (fleet.spaces, fleet.actors) == (None, {})


@pytest.mark.parametrize(("expected", "most"), [(8, 256), (100, 800), (1000, 4096)])
def test_an_actor_states_at_most_a_multiple_of_the_environments_that_the_run_expects(expected: int, most: int) -> None:
    fleet = Fleet(1, None, expected_environments=expected)
    refusal = fleet.join(Join(actor="b", incarnation=1, spaces=SPACES, environments=most + 1), 0.0)
    assert refusal is not None
    assert f"must be from 1 to {most}" in refusal.reason
    assert fleet.join(Join(actor="a", incarnation=1, spaces=SPACES, environments=most), 0.0) is None


def test_new_incarnation_replaces_an_absent_one_and_starts_without_sequence_numbers() -> None:
    fleet = joined_fleet("a")
    actor = fleet.actors["a"]
    assert fleet.find(identity("a")) is actor
    actor.sequences.add(0)
    fleet.set_present("a", 1, False, 0.0)
    assert fleet.join(Join(actor="a", incarnation=2), 0.0) is None
    assert fleet.find(identity("a")) is actor  # a Join without spaces replaces no incarnation
    assert fleet.find(identity("a", incarnation=2)) is None
    assert fleet.join(Join(actor="a", incarnation=2, spaces=SPACES, environments=3), 0.0) is None
    assert fleet.find(identity("a")) is None
    assert fleet.find(identity("a", incarnation=2)) is actor
    assert 0 not in actor.sequences
    assert actor.incarnations == 2


def test_second_join_of_an_incarnation_keeps_its_sequence_numbers() -> None:
    fleet = joined_fleet("a")
    fleet.actors["a"].sequences.add(0)
    assert fleet.join(Join(actor="a", incarnation=1), 1.0) is None
    assert 0 in fleet.actors["a"].sequences
    assert fleet.actors["a"].incarnations == 1
    assert fleet.find(identity("a")) is not None


def test_find_returns_none_for_an_unknown_actor() -> None:
    assert joined_fleet("a").find(identity("b")) is None


def test_live_actors_are_present_and_have_joined_with_spaces() -> None:
    fleet = joined_fleet("a", "b")
    fleet.join(Join(actor="c", incarnation=1), 0.0)
    fleet.set_present("c", 1, True, 0.0)
    fleet.set_present("d", 1, True, 0.0)
    fleet.join(Join(actor="e", incarnation=1, spaces=SPACES, environments=1), 0.0)
    assert fleet.live == {"a", "b"}
    fleet.set_present("a", 1, False, 0.0)
    assert fleet.live == {"b"}


@pytest.mark.parametrize("name", ["", "a b", "a/b", "*", "x" * 65, "-a", "é"])
def test_join_with_an_invalid_name_is_refused(name: str) -> None:
    fleet = Fleet(1, None)
    refusal = fleet.join(Join(actor=name, incarnation=1, spaces=SPACES, environments=1), 0.0)
    assert refusal is not None
    assert refusal.code == "malformed"
    assert "actor name" in refusal.reason
    assert not fleet.actors


def test_actor_absent_longest_is_evicted_at_capacity(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fleet_module, "_MAX_ACTORS", 20)
    fleet = Fleet(1, None)
    for number in range(20):
        assert attempt(fleet, f"a{number}", now=float(number)) is None
        fleet.set_present(f"a{number}", 1, True, float(number))
    refusal = attempt(fleet, "a20", now=20.0)
    assert refusal is not None
    assert (refusal.code, refusal.reason) == ("full", "20 actors have already joined")
    for away, at in ((7, 22.0), (5, 21.0), (9, 23.0)):
        fleet.set_present(f"a{away}", 1, False, at)
    assert attempt(fleet, "a20", now=24.0) is None
    assert len(fleet.actors) == 20
    assert "a5" not in fleet.actors
    assert {"a7", "a9"} < fleet.actors.keys()


def test_one_owner_cannot_fill_the_fleet(monkeypatch: pytest.MonkeyPatch) -> None:
    """A certificate for NAME allows NAME.anything."""
    monkeypatch.setattr(fleet_module, "_MAX_OF_ONE_OWNER", 3)
    fleet = joined_fleet("arm", "arm.1", "arm.2")
    refusal = attempt(fleet, "arm.3")
    assert refusal is not None
    assert (refusal.code, refusal.reason) == ("full", "3 actors have already joined as 'arm' or arm.ANYTHING")
    assert attempt(fleet, "box.3") is None
    fleet.set_present("arm.1", 1, False, 1.0)
    assert attempt(fleet, "arm.3", now=2.0) is None
    assert fleet.actors.keys() == {"arm", "arm.2", "arm.3", "box.3"}


def test_forgotten_actors_leave_room_for_others_of_their_owner(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each process of a host may have a name of its own, such as arm.PID: their number over time has no bound."""
    monkeypatch.setattr(fleet_module, "_MAX_OF_ONE_OWNER", 3)
    fleet = joined_fleet("arm", "arm.1", "arm.2")
    for name in ("arm", "arm.1", "arm.2"):
        fleet.set_present(name, 1, False, 0.0)
    fleet.forget_absent(1.0 + MINUTE)
    for number in range(3, 6):
        assert attempt(fleet, f"arm.{number}", now=100.0) is None
        fleet.set_present(f"arm.{number}", 1, True, 100.0)
    assert attempt(fleet, "arm.6", now=100.0) is not None


def test_tokens_of_one_owner_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fleet_module, "_MAX_TOKENS", 2)
    fleet = joined_fleet("arm", "arm.1", "arm.2", "box")
    assert fleet.live == {"arm", "arm.1", "box"}
    fleet.set_present("arm.2", 1, False, 0.0)
    fleet.set_present("arm.1", 1, False, 0.0)
    fleet.set_present("arm.2", 1, True, 0.0)
    assert fleet.live == {"arm", "arm.2", "box"}
    for name in ("arm", "arm.2", "box"):
        fleet.set_present(name, 1, False, 0.0)
    assert not fleet._presence._of_owner


def test_name_is_refused_while_its_incarnation_is_live() -> None:
    fleet = joined_fleet("a")
    other = Join(actor="a", incarnation=2, spaces=SPACES, environments=1)
    for asking in (other, Join(actor="a", incarnation=2)):
        refusal = fleet.join(asking, 1.0)
        assert refusal is not None
        assert (refusal.code, "'a'" in refusal.reason) == ("name_taken", True)
    assert (
        fleet.join(Join(actor="a", incarnation=1, spaces=SPACES, environments=5), 2.0) is None
    )  # the same incarnation
    fleet.set_present("a", 2, True, 0.0)  # its token may be present before it joins
    assert fleet.join(other, 3.0) is not None
    fleet.set_present("a", 1, False, 0.0)
    assert fleet.join(other, 4.0) is None
    assert fleet.live == {"a"}
    assert fleet.actors["a"].incarnations == 2


def test_name_of_a_quarantined_actor_can_be_reused() -> None:
    fleet = joined_fleet("a")
    fleet.actors["a"].quarantined = "nonsense"
    assert fleet.join(Join(actor="a", incarnation=2, spaces=SPACES, environments=1), 0.0) is None


def test_presence_of_another_incarnation_does_not_make_an_actor_live() -> None:
    fleet = joined_fleet("a")
    fleet.set_present("a", 2, True, 0.0)
    fleet.set_present("a", 1, False, 0.0)
    assert not fleet.live
    assert [status.alive for status in query_responses.page(fleet, "", 0.0)] == [False]


def test_presence_without_join_does_not_create_an_actor() -> None:
    fleet = Fleet(1, None)
    fleet.set_present("a", 1, True, 0.0)
    assert not fleet.actors
    fleet.join(Join(actor="a", incarnation=1, spaces=SPACES, environments=1), 0.0)
    assert fleet.live == {"a"}


def test_missed_rollouts_are_counted_and_fit_the_wire_integer() -> None:
    fleet = joined_fleet("a")
    fleet.actors["a"].sequences.add(WINDOW + 4)
    assert query_responses.page(fleet, "", 0.0)[0].rollouts_missed == 5
    fleet.actors["a"].sequences.add(2**63 - 1)
    fleet.join(Join(actor="a", incarnation=2, spaces=SPACES, environments=1), 0.0)
    fleet.actors["a"].sequences.add(2**63 - 1)
    assert query_responses.page(fleet, "", 0.0)[0].rollouts_missed < 2**63


def test_seeds_depend_on_actor_incarnation_start_version_and_run_seed() -> None:
    def seeds(run_seed: int) -> dict[tuple[str, int, int], int]:
        fleet = Fleet(run_seed, None)
        found = {}
        for incarnation in (1, 2):
            for name in ("a", "b"):
                fleet.join(Join(actor=name, incarnation=incarnation, spaces=SPACES, environments=1), 0.0)
                for start in (0, 500):
                    found[name, incarnation, start] = fleet.seed_for(name, start)
        return found

    assert seeds(1) == seeds(1)
    assert len({*seeds(1).values(), *seeds(2).values()}) == 16


def test_epsilon_is_drawn_by_seed_and_name_and_is_the_same_after_a_restart() -> None:
    epsilons = (0.1,) * 4 + (0.01,) * 3 + (0.5,) * 3

    def drawn(seed: int) -> list[float]:
        return [Fleet(seed, None, epsilons).epsilon_for(f"actor-{number}") for number in range(1000)]

    assert drawn(1) == drawn(1) != drawn(2)
    shares = {epsilon: drawn(1).count(epsilon) / 1000 for epsilon in epsilons}
    assert shares == pytest.approx({0.1: 0.4, 0.01: 0.3, 0.5: 0.3}, abs=0.06)
    fleet = Fleet(1, None, epsilons)
    for incarnation in (1, 2):
        assert attempt(fleet, "actor-0", incarnation) is None
        assert fleet.actors["actor-0"].epsilon == drawn(1)[0]
        assert query_responses.page(fleet, "", 0.0)[0].epsilon == drawn(1)[0]


def test_names_with_the_same_checksum_share_neither_seed_nor_epsilon() -> None:
    """CRC-32 of both names is the same."""
    fleet = Fleet(2, None, tuple(number / 1000 for number in range(1000)))
    names = ("plumless", "buckeroo")
    assert len({fleet.seed_for(name, 0) for name in names}) == 2
    assert len({fleet.epsilon_for(name) for name in names}) == 2


def test_statuses_are_sorted_by_actor_name() -> None:
    fleet = joined_fleet("b", "a")
    fleet.actors["b"].rejected["stale"] += 2
    fleet.actors["b"].accepted = 5
    fleet.set_present("b", 1, False, 0.0)
    first, second = query_responses.page(fleet, "", 3.0)
    assert (first.actor, first.alive, first.seconds_since_seen, first.environments) == ("a", True, 3.0, 3)
    assert (second.actor, second.alive, second.rollouts_accepted) == ("b", False, 5)
    assert second.rollouts_rejected == {"stale": 2}


# ------------------------------------------------------------------------------------------ forgetting


def test_actor_is_forgotten_a_minute_after_it_left() -> None:
    fleet = joined_fleet("a", "b")
    fleet.set_present("a", 1, False, 100.0)
    fleet.forget_absent(99.0 + MINUTE)
    assert fleet.actors.keys() == {"a", "b"}
    fleet.forget_absent(101.0 + MINUTE)
    assert fleet.actors.keys() == {"b"}
    fleet.forget_absent(500.0)
    assert fleet.actors.keys() == {"b"}  # it is present, however long it sends nothing


def test_run_totals_do_not_fall_when_an_actor_is_forgotten() -> None:
    fleet = joined_fleet("a", "b")
    for name in ("a", "b"):
        fleet.actors[name].busy = 5
        fleet.actors[name].sequences.add(WINDOW + 1)
    fleet.actors["b"].quarantined = "unfit"
    expected = {"rollouts_missed": 4, "busy_answers": 10, "actors_alive": 1, "actors_quarantined": 1, "actors_gone": 0}
    assert query_responses.totals(fleet) == expected
    fleet.set_present("a", 1, False, 1.0)
    assert query_responses.totals(fleet) == {**expected, "actors_alive": 0, "actors_gone": 1}
    fleet.forget_absent(2.0 + MINUTE)
    missed = 4 + WINDOW - 1  # what was missing within the window is given up
    assert query_responses.totals(fleet) == {**expected, "actors_alive": 0, "rollouts_missed": missed}


def test_forgotten_incarnation_that_returns_continues_above_its_highest_sequence_number() -> None:
    """Otherwise a rollout that is sent again would be trained on twice."""
    fleet = joined_fleet("a")
    for sequence in (0, 1, 4):
        fleet.actors["a"].sequences.add(sequence)
    seed = fleet.seed_for("a", 0)
    fleet.set_present("a", 1, False, 0.0)
    fleet.forget_absent(1.0 + MINUTE)
    assert fleet.find(identity("a")) is None
    assert attempt(fleet, "a", now=100.0) is None
    sequences = fleet.actors["a"].sequences
    assert [number for number in range(7) if number not in sequences] == [5, 6]
    assert fleet.seed_for("a", 0) != seed


def test_replaced_incarnation_never_becomes_current_again() -> None:
    """After however many others: its rollouts of that time cannot be trained on twice."""
    fleet = joined_fleet("a")
    fleet.set_present("a", 1, False, 0.0)
    for incarnation in range(2, 40):
        assert attempt(fleet, "a", incarnation) is None
    for incarnation in (1, 2, 38):
        for join in (Join(actor="a", incarnation=incarnation), None):
            refusal = fleet.join(join, 0.0) if join else attempt(fleet, "a", incarnation)
            assert refusal is not None
            assert refusal.code == "name_taken"
            assert "another process has joined as 'a' since" in refusal.reason
    assert attempt(fleet, "a", 39) is None
    fleet.forget_absent(1.0 + MINUTE)
    assert not fleet.actors
    assert attempt(fleet, "a", 1, now=200.0) is not None


def test_quarantined_incarnation_is_not_accepted_after_it_was_forgotten() -> None:
    fleet = joined_fleet("a")
    fleet.actors["a"].quarantined = "nonsense"
    fleet.set_present("a", 1, False, 0.0)
    fleet.forget_absent(1.0 + MINUTE)
    refusal = attempt(fleet, "a", now=100.0)
    assert refusal is not None
    assert (refusal.code, refusal.reason) == ("malformed", "this process was quarantined: nonsense; restart it")
    assert attempt(fleet, "a", 2, now=100.0) is None


def test_number_of_remembered_incarnations_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fleet_module, "_MAX_FORMER", 10)
    fleet = Fleet(1, None)
    for incarnation in range(100):
        assert attempt(fleet, "a", incarnation) is None
    assert len(fleet._former) == 10


# ---------------------------------------------------------------------------------------------- status


def test_pages_of_the_status_contain_every_actor_once() -> None:
    fleet = joined_fleet(*(f"a{number}" for number in range(2 * PAGE_ACTORS + 50)))
    pages, after = [], ""
    while page := query_responses.page(fleet, after, 0.0):
        pages.append([status.actor for status in page])
        after = page[-1].actor
    assert [len(each) for each in pages] == [PAGE_ACTORS, PAGE_ACTORS, 50]
    assert [name for each in pages for name in each] == sorted(fleet.actors)


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
