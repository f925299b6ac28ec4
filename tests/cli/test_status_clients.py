"""What `daedalus status` shows of clients."""

from statuses import actor_status

from daedalus.cli.commands.status import _client_texts


def test_an_actor_that_reports_nothing_has_no_line() -> None:
    assert _client_texts(actor_status("a")) == []


def test_a_client_has_lines_with_its_counts() -> None:
    client = actor_status(
        "a", deadlines=1200, missed_deadlines=3, rows=200, overridden_actions=5, safe_actions=40, rollouts_dropped=2
    )
    assert _client_texts(client) == [
        "counts 3 of 1,200 deadlines missed, 5 actions overridden (2.5%), 40 safe actions, 2 rollouts dropped"
    ]
    assert _client_texts(actor_status("a", deadlines=1200)) == ["counts 0 of 1,200 deadlines missed"]
    assert _client_texts(actor_status("a", safe_reason="why")) == ["plays the safe action: why"]
    assert _client_texts(actor_status("a", safe_reason="why", alive=False)) == []
