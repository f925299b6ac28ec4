"""Foreign texts, bounded and printable; names and keys."""

import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daedalus.protocol import keys
from daedalus.protocol.texts import (
    bounded_text,
    mebibytes,
    one_line,
    printable,
    short_number,
    short_share,
    without_secrets,
)

offline = settings(max_examples=200, deadline=None, derandomize=True)


@pytest.mark.parametrize(
    ("text", "most", "expected"),
    [
        ("no module named 'x'", 300, "no module named 'x'"),
        ("x" * 5000, 300, "x" * 300),
        ("\U0001f600" * 80, 300, "\U0001f600" * 75),
        ("éé", 3, "é"),  # no half character
        ("two\nlines\tand\x1b[2J\u2028more  spaces ", 300, "two lines and [2J more spaces"),
        ("\ud800 alone", 300, "alone"),
        ("", 300, ""),
    ],
)
def test_text_is_cut_to_bytes_and_to_what_can_be_printed(text: str, most: int, expected: str) -> None:
    assert bounded_text(text, most) == expected


@offline
@given(text=st.text(), most=st.integers(0, 30))
def test_any_text_becomes_printable_and_small(text: str, most: int) -> None:
    bounded = bounded_text(text, most)
    assert bounded.isprintable()
    assert len(bounded.encode()) <= most
    assert bounded_text(bounded, most) == bounded.rstrip()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("é ± 日本 \U0001f600\tand\nmore", "é ± 日本 \U0001f600\tand\nmore"),
        ("\x1b[2J\r\x7f\x9b\0", r"\x1b[2J\r\x7f\x9b\x00"),
        ("a\u202eb\u2066c\u200b\ufeff", r"a\u202eb\u2066c\u200b\ufeff"),
        ("a\u2028b\u2029c\x85d", r"a\u2028b\u2029c\x85d"),
        ("\udcff\ud800 \U000e0041", r"\udcff\ud800 \U000e0041"),
    ],
)
def test_what_is_not_printable_is_escaped(text: str, expected: str) -> None:
    assert printable(text) == expected


@offline
@given(text=st.text())
def test_any_text_becomes_printable(text: str) -> None:
    assert printable(text).replace("\n", "").replace("\t", "").isprintable()
    assert one_line(text).isprintable()


SHOWN = {0.0: "0", 1.2e-5: "1.2e-05", -0.0345: "-0.0345", 0.98765: "0.988", -475.25: "-475.2", 1e6: "1,000,000"} | {
    1_000_001.0: "1,000,001",
    2e-5: "2e-05",
    1e300: "1e+300",
    -0.0: "0",
}


@pytest.mark.parametrize(("value", "text"), SHOWN.items())
def test_numbers_of_any_size_have_three_digits_that_count(value: float, text: str) -> None:
    assert short_number(value) == text


@pytest.mark.parametrize(
    ("share", "text"), [(0.0, "0%"), (1e-9, "<1%"), (0.006, "1%"), (0.994, "99%"), (0.996, ">99%"), (1.0, "100%")]
)
def test_a_share_is_all_or_nothing_only_if_it_is(share: float, text: str) -> None:
    assert short_share(share) == text


@pytest.mark.parametrize(
    ("sizes", "texts"),
    [
        ((3 << 30, 1 << 20), ["3,072", "1"]),
        ((20_480, 10_485), ["0.02", "0.01"]),
        ((1_048_577, 1_048_576), ["1.000001", "1.000000"]),
        ((5 << 19, 0), ["2", "0"]),
        ((1, 0), ["0.000001", "0.000000"]),
    ],
)
def test_different_sizes_have_different_texts(sizes: tuple[int, ...], texts: list[str]) -> None:
    assert mebibytes(*sizes) == texts


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("ConnectError: http://ada:pa55w0rd@host:5000/api refused", "ConnectError: http://***@host:5000/api refused"),
        ("postgresql+psycopg://u:a@b:c@db/x", "postgresql+psycopg://***@db/x"),
        ("https://0123abcd@api.wandb.ai", "https://***@api.wandb.ai"),
        ("GET /runs?page=2&access_token=abc123&x=1", "GET /runs?page=2&access_token=***&x=1"),
        ("WANDB_API_KEY=0123456789 is not valid", "WANDB_API_KEY=*** is not valid"),
        (
            "{'Authorization': 'Bearer abcdefghijk', 'password': 'hunter2'}",
            "{'Authorization': 'Bearer ***', 'password': '***'}",
        ),
        ("invalid token hf_abcdefghijklmnopqrst", "invalid token ***"),
        ("key in-the-environment was refused", "key *** was refused"),
        ("ada%3Ab!tter was refused", "ada%3Ab!tter was refused"),
        ("db says: p@ss/word1 or p%40ss%2Fword1", "db says: *** or ***"),
        (
            "the token of client 'arm' is missing: daedalus certs token",
            "the token of client 'arm' is missing: daedalus certs token",
        ),
        (
            "training.learning_rate=0.001, seed: 3, tcp/10.0.0.1:7447",
            "training.learning_rate=0.001, seed: 3, tcp/10.0.0.1:7447",
        ),
        ("TOKENIZERS_PARALLELISM is false", "TOKENIZERS_PARALLELISM is false"),
        ("ask ada@example.org, see https://example.org/a@b", "ask ada@example.org, see https://example.org/a@b"),
    ],
)
def test_passwords_and_tokens_are_hidden(text: str, shown: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WANDB_API_KEY", "in-the-environment")
    monkeypatch.setenv("TOKENIZERS_PARALLELISM", "false")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "postgresql://u:p%40ss%2Fword1@db")
    assert without_secrets(text) == shown
    assert without_secrets(shown) == shown
    assert bounded_text(text) == shown


names = st.from_regex(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}", fullmatch=True)


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
