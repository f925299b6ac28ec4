import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daedalus.protocol import keys

names = st.from_regex(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}", fullmatch=True)
offline = settings(max_examples=50, deadline=None, derandomize=True)


@pytest.mark.parametrize(
    "name", ["", "a/b", "*", "a*", "**", "$", "a$", "-a", ".a", "_a", "a b", "a\n", "é", "a?", "a#", "x" * 65]
)
def test_invalid_name_is_rejected(name: str) -> None:
    with pytest.raises(ValueError, match="actor name"):
        keys.check_name(name, "actor name")


@offline
@given(text=st.text(), other=st.text())
def test_any_text_becomes_a_name_of_its_own(text: str, other: str) -> None:
    assert keys.is_name(keys.as_name(text))
    assert (keys.as_name(text) == keys.as_name(other)) == (text == other)


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("cartpole-a2c", "cartpole-a2c"),
        ("a run", "a-run-"),
        (".try#1", "try-1-"),
        ("配置", "run-"),
        ("\udcff", "run-"),
        ("", "run-"),
        ("x" * 65, "x" * 55 + "-"),
    ],
)
def test_name_of_a_text_shows_what_it_can_of_it(text: str, name: str) -> None:
    made = keys.as_name(text)
    assert made == name if keys.is_name(text) else re.fullmatch(re.escape(name) + "[0-9a-f]{8}", made)
    assert keys.is_name(made)


@offline
@given(run=names, actor=names, incarnation=st.integers(0, 2**63 - 1))
def test_keys_of_a_run_are_distinct_and_say_whose_they_are(run: str, actor: str, incarnation: int) -> None:
    assert keys.check_name(run, "run") == run
    of_actor = [key_of(run, actor) for key_of in (keys.join, keys.rollouts, keys.evaluations)]
    assert [keys.last_chunk(key) for key in of_actor] == [actor] * 3
    presence = keys.presence(run, actor, incarnation)
    assert keys.parse_presence(presence) == (actor, incarnation)
    made = [*of_actor, presence, keys.program(run, actor), keys.snapshots(run), keys.learner(run), keys.status(run)]
    assert len(set(made)) == len(made)
    assert all(key.startswith(f"daedalus/{run}/") for key in made)


@pytest.mark.parametrize("life", ["", "x", "-1", "1.0", "*", "9" * 20, "\u0663"])
def test_malformed_presence_key_gives_none(life: str) -> None:
    assert keys.parse_presence(keys.presence("r", "a", life)) is None


@pytest.mark.parametrize(
    ("queried", "expected"),
    [
        ("daedalus/r/join/a", "daedalus/r/join/a"),
        ("daedalus/*/join/a", "daedalus/r/join/a"),
        ("daedalus/r/join/*", "daedalus/r/join/*"),
        ("daedalus/$*/join/a", "daedalus/r/join/a"),
        ("daedalus/**", "daedalus/r/join/*"),
        ("daedalus/**/join/a", "daedalus/r/join/a"),
        ("**", "daedalus/r/join/*"),
    ],
)
def test_intersection_takes_the_chunks_that_are_not_wildcards(queried: str, expected: str) -> None:
    """Whatever a stranger queries, it must not raise: that would end the learner."""
    assert keys.intersection("daedalus/r/join/*", queried) == expected
