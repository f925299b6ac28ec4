"""`daedalus push` and pulling the policy again, with the real huggingface_hub and a stand-in of the Hub on loopback."""

import errno
import json
import logging
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hub_server import TOKEN, HubServer, serving
from league_statuses import LEAGUE
from recorded_runs import record
from saved_runs import CARTPOLE, COUNTING, save
from test_report_command import GIF, HOSTILE, evaluated, happened

import daedalus
from daedalus.analysis import hub_upload
from daedalus.cli.commands.evaluate import main as evaluate
from daedalus.cli.commands.push import push
from daedalus.policy.saving import hub as hub_module
from daedalus.policy.saving.hub import HubError, pull
from daedalus.policy.saving.saved_policy import find_policy, read_policy
from daedalus.policy.saving.sealed import DamagedError
from daedalus.protocol.spec import EnvironmentSpec

pytest.importorskip("huggingface_hub")
pytestmark = pytest.mark.filterwarnings("ignore:Use 'content=<...>' to upload:DeprecationWarning")  # in huggingface_hub
GAME = EnvironmentSpec(id="pettingzoo.classic.tictactoe_v3", backend="pettingzoo")
POLICY = {"manifest.json", "seal", "program.onnx", "parameters.safetensors"}


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[HubServer]:
    """A Hub that the library asks instead of the real one, with a token that may write and an empty cache."""
    from huggingface_hub import close_session, constants

    with serving() as server, ExitStack() as stack:
        stack.callback(close_session)  # it would keep its connections, and the server their threads
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(constants, "ENDPOINT", server.address)
        template = server.address + "/{repo_id}/resolve/{revision}/{filename}"
        monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", template)
        monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
        monkeypatch.setattr(constants, "HF_TOKEN_PATH", str(tmp_path / "no token"))
        monkeypatch.setattr(constants, "HF_HUB_DISABLE_XET", True)  # the stand-in takes large files by HTTP
        monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
        monkeypatch.setenv("HF_TOKEN", TOKEN)
        yield server


def run_of(folder: Path, *versions: int, environment: Any = CARTPOLE, **summary: Any) -> Path:
    """Record a run with a policy and an evaluation of its newest one."""
    run = evaluated(record(folder, **summary), policy_version=versions[-1])
    save(run, environment, *versions)
    return run


def metadata(card: bytes) -> dict[str, Any]:
    yaml = pytest.importorskip("yaml")
    return yaml.safe_load(card.decode().split("---\n")[1])


def line(capsys: pytest.CaptureFixture[str]) -> str:
    captured = capsys.readouterr()
    assert captured.out == ""
    (only,) = captured.err.splitlines()
    return only


def same(first: Mapping[str, np.ndarray], second: Mapping[str, np.ndarray]) -> bool:
    return first.keys() == second.keys() and all(np.array_equal(first[name], second[name]) for name in first)


def test_a_pushed_policy_is_pulled_again(hub: HubServer, capsys: pytest.CaptureFixture[str]) -> None:
    run = run_of(Path("run"), 3, 4)
    (run / "replay.mp4").write_bytes(b"a video")
    versions = json.loads((run / "versions.json").read_text())
    (run / "versions.json").write_text(json.dumps({**versions, "init_from": "/home/ada/runs/first"}))
    assert push(["run", "ada/cart"]) == 0
    address = capsys.readouterr().out.removeprefix("pushed to ").strip()
    assert address.startswith(f"{hub.address}/ada/cart/commit/")
    files = hub.files("ada/cart")
    texts = {"README.md", "config.toml", "metrics.csv", "evaluation.json", "versions.json"}
    assert set(files) == {".gitattributes", *POLICY, *texts, "replay.mp4"}
    assert files["config.toml"] == (run / "config.toml").read_bytes()
    assert files["replay.mp4"] == b"a video"
    assert json.loads(files["versions.json"])["gymnasium"] == versions["gymnasium"]
    assert b"/home/ada" not in b"".join(files.values())
    assert b"The run began with the weights of another run." in files["README.md"]
    assert "checkpoint" not in json.loads(files["evaluation.json"])  # a path of this machine
    pulled, saved = read_policy(pull("ada/cart")), find_policy(run)
    assert (pulled.policy_version, pulled.program, pulled.spec) == (4, saved.program, saved.spec)
    assert same(pulled.weights, saved.weights)


def test_the_model_card_has_the_results(hub: HubServer) -> None:
    happened(
        run_of(Path("run"), 4, rollouts_rejected={"stale": 3}, league=LEAGUE),
        ("started", "", "x"),
        ("left", "arm-on-host-7", "gone"),
    )
    assert push(["run", "ada/cart"]) == 0
    card = hub.files("ada/cart")["README.md"]
    found = metadata(card)
    assert found["library_name"] == "daedalus-rl"
    assert found["pipeline_tag"] == "reinforcement-learning"
    (model,) = found["model-index"]
    assert model["name"] == "cart"
    (result,) = model["results"]
    assert result["task"]["type"] == "reinforcement-learning"
    assert result["dataset"] == {"name": "CartPole-v1", "type": "CartPole-v1"}
    mean, middle = result["metrics"]
    assert (mean["type"], mean["value"]) == ("mean_reward", "433.75 +/- 130.09")
    assert (middle["type"], middle["value"]) == ("interquartile_mean_reward", 492.5)
    text = card.decode()
    assert "daedalus evaluate --from-hub ada/cart" in text
    assert "| 95 % bootstrap interval | " in text
    assert "| rollout rejected (times) | 3 |" in text
    assert "| rating in its league | 1,312 ± 50 |" in text
    assert "| win rate against random | 97% |" in text
    assert "arm-on-host-7" not in b"".join(hub.files("ada/cart").values()).decode("utf-8", "replace")


def test_a_second_push_replaces_the_files_of_the_first(hub: HubServer) -> None:
    run = run_of(Path("run"), 4)
    (run / "replay.gif").write_bytes(GIF)
    assert push(["run", "ada/cart"]) == 0
    assert b"![An episode](replay.gif)" in hub.files("ada/cart")["README.md"]
    (run / "replay.gif").unlink()
    hub.repositories["ada/cart"].commit({**hub.files("ada/cart"), "notes.txt": b"of the user"})
    save(run, CARTPOLE, 5, weights_seed=6)
    assert push(["run", "ada/cart"]) == 0
    files = hub.files("ada/cart")
    assert "replay.gif" not in files
    assert files["notes.txt"] == b"of the user"
    assert read_policy(pull("ada/cart")).policy_version == 5


def test_an_evaluation_of_another_policy_is_not_the_result(hub: HubServer, capsys: pytest.CaptureFixture[str]) -> None:
    run = run_of(Path("run"), 4)
    save(run, CARTPOLE, 9)
    assert push(["run", "ada/cart"]) == 0
    assert "model-index" not in metadata(hub.files("ada/cart")["README.md"])
    assert "evaluation.json" not in hub.files("ada/cart")
    (warning,) = capsys.readouterr().err.splitlines()
    assert "is of policy version 4, the policy is version 9" in warning
    assert warning.endswith("before the push: daedalus evaluate run --record")


def test_texts_of_the_run_are_no_markup_in_the_card(hub: HubServer) -> None:
    hostile = HOSTILE + "\n---\n| a | [x](http://evil.example) ![](http://evil.example) @ada ```"
    run = run_of(Path("run"), 4, rollouts_rejected={hostile: 1})
    evaluated(run, policy_version=4, notes=[hostile], backend=hostile, actions=hostile, environment=hostile)
    (run / "versions.json").write_text(json.dumps({hostile: hostile}))
    assert push(["run", "ada/cart"]) == 0
    card = hub.files("ada/cart")["README.md"]
    assert metadata(card)["library_name"] == "daedalus-rl"
    markdown = pytest.importorskip("markdown_it").MarkdownIt("gfm-like", {"linkify": False})
    html = markdown.enable("table").render(card.decode().split("---\n", 2)[2])
    assert "alert(1)" in html
    assert "<script" not in html
    assert "<img" not in html
    assert "<a " not in html


def test_a_link_in_the_run_directory_is_not_uploaded(hub: HubServer, capsys: pytest.CaptureFixture[str]) -> None:
    run = run_of(Path("run"), 4)
    Path("secret").write_bytes((run / "metrics.csv").read_bytes())
    (run / "metrics.csv").unlink()
    (run / "metrics.csv").symlink_to(Path("secret").absolute())
    assert push(["run", "ada/cart"]) == 1
    assert "metrics.csv is a link to another file, which is not uploaded" in line(capsys)
    assert "ada/cart" not in hub.repositories


def test_a_private_repository_needs_the_token(hub: HubServer, monkeypatch: pytest.MonkeyPatch) -> None:
    run_of(Path("run"), 4)
    assert push(["run", "ada/secret", "--private"]) == 0
    assert hub.repositories["ada/secret"].private
    monkeypatch.delenv("HF_TOKEN")
    with pytest.raises(HubError, match="no repository ada/secret on the Hub, or it is private: check the name; for a"):
        pull("ada/secret")


@pytest.mark.parametrize("kwargs", [{"address": "http://ada:pa55w0rd@host"}, {"simulator": {"api_key": "abc123"}}])
def test_a_password_in_the_settings_is_not_published(
    hub: HubServer, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, kwargs: dict[str, Any]
) -> None:
    policy = find_policy(run_of(Path("run"), 1))
    environment = policy.spec.environment.model_copy(update={"kwargs": kwargs})  # CartPole itself takes none
    policy = replace(policy, spec=policy.spec.model_copy(update={"environment": environment}))
    monkeypatch.setattr("daedalus.analysis.hub_upload.find_policy", lambda *_: policy)
    assert push(["run", "ada/cart"]) == 1
    message = line(capsys)
    assert f"environment.kwargs.{next(iter(kwargs))}" in message
    assert "holds a password or a token" in message
    assert "pa55w0rd" not in message


def test_a_private_push_never_ends_in_a_public_repository(hub: HubServer, capsys: pytest.CaptureFixture[str]) -> None:
    run_of(Path("run"), 4)
    assert push(["run", "ada/cart"]) == 0
    before = hub.files("ada/cart")
    capsys.readouterr()
    assert push(["run", "ada/cart", "--private"]) == 1
    assert line(capsys) == (
        "daedalus push: ada/cart is public: make it private in its settings on the Hub, or choose another name"
    )
    assert hub.files("ada/cart") == before
    hub.repositories["ada/cart"].private = True
    assert push(["run", "ada/cart", "--private"]) == 0


# ------------------------------------------------------------------------------------------------- bad input


def no_token(hub: HubServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("HF_TOKEN")


def wrong_token(hub: HubServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_TOKEN", "hf_wrong")


def offline(hub: HubServer, monkeypatch: pytest.MonkeyPatch) -> None:
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)


def gone(hub: HubServer, monkeypatch: pytest.MonkeyPatch) -> None:
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "ENDPOINT", "http://127.0.0.1:9")  # nothing listens there


def silent(hub: HubServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hub_upload, "_WAIT_SECONDS", 0.2)
    monkeypatch.setattr(hub_module, "_ANSWER_SECONDS", 0.2)
    hub.answers.clear()


def not_installed(hub: HubServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)


def failing(hub: HubServer, monkeypatch: pytest.MonkeyPatch) -> None:
    hub.status = 418


def something_else(hub: HubServer, monkeypatch: pytest.MonkeyPatch) -> None:
    hub.add("ada/cart", {"model.bin": b"", "README.md": b"precious"})


def nothing(hub: HubServer, monkeypatch: pytest.MonkeyPatch) -> None:
    pass


@pytest.mark.parametrize(
    ("trouble", "words", "message"),
    [
        (no_token, "run ada/cart", "not logged in to the Hub: log in with `hf auth login`, or set HF_TOKEN"),
        (wrong_token, "run ada/cart", "the Hub refuses this for ada/cart (status 401): log in with `hf auth login`"),
        (nothing, "run bob/cart", "the Hub refuses this for bob/cart (status 403): log in with"),
        (offline, "run ada/cart", "the Hub is not asked, because HF_HUB_OFFLINE is set: unset HF_HUB_OFFLINE"),
        (gone, "run ada/cart", "the Hub cannot be reached ("),
        (silent, "run ada/cart", "the Hub cannot be reached (timed out): check the network"),
        (not_installed, "run ada/cart", 'the Hub needs huggingface-hub: pip install "daedalus-rl[hub]"'),
        (failing, "run ada/cart", "the Hub answers with status 418: the stand-in was told to fail; try again later"),
        (
            something_else,
            "run ada/cart",
            "ada/cart has files that are not of a policy of Daedalus: choose another name",
        ),
        (nothing, "nowhere ada/cart", "nowhere does not exist: name a run directory"),
        (nothing, "empty ada/cart", "empty has no checkpoints yet: its learner saves the first one after"),
    ],
)
def test_a_push_that_fails_is_one_line(
    hub: HubServer,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    trouble: Callable[..., None],
    words: str,
    message: str,
) -> None:
    run_of(Path("run"), 4)
    evaluated(record(Path("empty")))
    trouble(hub, monkeypatch)
    assert push(words.split()) == 1
    assert line(capsys).startswith(f"daedalus push: {message}")
    if trouble is something_else:
        assert hub.files("ada/cart")["README.md"] == b"precious"


@pytest.mark.parametrize(
    ("trouble", "words", "message"),
    [
        (nothing, "ada/other", "there is no repository ada/other on the Hub, or it is private: check the name"),
        (nothing, "ada/cart --revision v7", "ada/cart has no revision 'v7': name a branch, a tag or a commit"),
        (offline, "ada/cart", "the Hub is not asked, because HF_HUB_OFFLINE is set, and this machine has no copy of"),
        (gone, "ada/cart", "the Hub cannot be reached ("),
        (silent, "ada/cart", "the Hub cannot be reached (timed out), and this machine has no copy of ada/cart: check"),
        (not_installed, "ada/cart", 'the Hub needs huggingface-hub: pip install "daedalus-rl[hub]"'),
        (failing, "ada/cart", "the Hub answers with status 418: the stand-in was told to fail; try again later"),
        (something_else, "ada/cart", "ada/cart has no file manifest.json: it is not a policy that `daedalus push`"),
    ],
)
def test_a_pull_that_fails_is_one_line(
    hub: HubServer,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    trouble: Callable[..., None],
    words: str,
    message: str,
) -> None:
    run_of(Path("run"), 4)
    assert push(["run", "ada/cart"]) == 0
    capsys.readouterr()
    trouble(hub, monkeypatch)
    assert evaluate(["--from-hub", *words.split(), "--episodes", "1"]) == 1
    assert line(capsys).startswith(f"daedalus evaluate: {message}")


@pytest.mark.parametrize("name", ["cart", "ada/../cart", ""])
def test_a_name_that_no_repository_can_have_is_bad_usage(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    for command, words in ((push, ["run", name]), (evaluate, ["--from-hub", name])):
        assert command(words) == 2
        assert f"{name!r} is not the name of a repository: write USER/NAME" in line(capsys)


# ----------------------------------------------------------------------------------------------------- pulling


def test_a_policy_on_the_hub_is_evaluated(hub: HubServer, capsys: pytest.CaptureFixture[str]) -> None:
    run_of(Path("run"), 4)
    assert push(["run", "ada/cart"]) == 0
    repository = hub.repositories["ada/cart"]
    repository.names["v1"] = repository.commits[-1][0]
    save(Path("run"), CARTPOLE, 5)
    assert push(["run", "ada/cart"]) == 0
    for words, version in (([], 5), (["--revision", "v1"], 4), (["--revision", repository.names["v1"]], 4)):
        capsys.readouterr()
        assert evaluate(["--from-hub", "ada/cart", *words, "--episodes", "2", "--json"]) == 0
        result = json.loads(capsys.readouterr().out)
        assert (result["policy_version"], result["episodes"]) == (version, 2)
    policy = daedalus.load_policy(from_hub="ada/cart", revision="v1")
    assert policy.policy_version == 4
    assert policy.act(np.zeros(4, np.float32)) in (0, 1)


def test_a_pulled_policy_is_used_again_without_the_hub(hub: HubServer, monkeypatch: pytest.MonkeyPatch) -> None:
    run_of(Path("run"), 4)
    assert push(["run", "ada/cart"]) == 0
    first = pull("ada/cart")
    hub.requests.clear()
    offline(hub, monkeypatch)
    assert pull("ada/cart") == first
    assert hub.requests == []


def test_a_policy_is_used_from_a_cache_that_cannot_be_written(hub: HubServer, monkeypatch: pytest.MonkeyPatch) -> None:
    run_of(Path("run"), 4)
    assert push(["run", "ada/cart"]) == 0
    folder = pull("ada/cart")

    def read_only(*_: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(hub_module, "replace_text", read_only)
    assert pull("ada/cart") == folder


def test_only_the_files_of_a_policy_are_pulled(hub: HubServer) -> None:
    run_of(Path("run"), 4)
    assert push(["run", "ada/cart"]) == 0
    extra = {"../../escape.py": b"", "sitecustomize.py": b"1/0", "model.pkl": b"cos\nsystem\n", "big.bin": b"x" * 1000}
    hub.repositories["ada/cart"].commit({**hub.files("ada/cart"), **extra})
    hub.requests.clear()
    folder = pull("ada/cart")
    assert {path.name for path in folder.iterdir()} == POLICY
    downloads = {each.rpartition("/")[2] for each in hub.requests if each.startswith("GET /ada/cart/resolve")}
    assert downloads == POLICY


def test_a_module_of_a_pulled_policy_is_imported_only_if_it_is_allowed(
    hub: HubServer, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run_of(Path("run"), 4, environment=COUNTING)
    assert push(["run", "ada/count"]) == 0
    assert (
        b"daedalus evaluate --from-hub ada/count --allow-module counting_environment\n"
        in hub.files("ada/count")["README.md"]
    )
    capsys.readouterr()
    words = ["--from-hub", "ada/count", "--episodes", "1"]
    with monkeypatch.context() as changed:
        changed.delitem(sys.modules, "counting_environment")
        assert evaluate(words) == 2
        assert "counting_environment" not in sys.modules
    assert line(capsys) == (
        "daedalus evaluate: the run of ada/count asks for environment.id=counting_environment:Counting-v0, but the "
        "module counting_environment may not be imported here; if you trust that code, type: "
        "daedalus evaluate --from-hub ada/count --episodes 1 --allow-module counting_environment"
    )
    assert evaluate([*words, "--allow-module", "counting_environment"]) == 0


@pytest.mark.parametrize(
    ("file", "size", "message"),
    [
        (
            "parameters.safetensors",
            (1 << 30) + 1,
            "parameters.safetensors of ada/cart has 1073741825 bytes, the limit is",
        ),
        ("program.onnx", 17 << 20, "program.onnx of ada/cart has 17825792 bytes, the limit is 16,777,216"),
        ("seal", -1, "seal of ada/cart has -1 bytes"),
        ("manifest.json", None, "manifest.json of ada/cart has None bytes"),
    ],
)
def test_sizes_are_checked_before_anything_is_pulled(hub: HubServer, file: str, size: Any, message: str) -> None:
    run_of(Path("run"), 4)
    assert push(["run", "ada/cart"]) == 0
    hub.sizes[file] = size
    hub.requests.clear()
    with pytest.raises(HubError, match=message):
        pull("ada/cart")
    assert not any("/resolve/" in each for each in hub.requests)


def test_a_branch_that_moves_after_the_check_does_not_matter(hub: HubServer, monkeypatch: pytest.MonkeyPatch) -> None:
    run_of(Path("run"), 4)
    assert push(["run", "ada/cart"]) == 0
    check = hub_module._checked_commit

    def moving(*arguments: Any) -> str:
        commit = check(*arguments)
        hub.repositories["ada/cart"].commit({**hub.files("ada/cart"), "seal": b"x" * 100_000})
        return commit

    monkeypatch.setattr(hub_module, "_checked_commit", moving)
    folder = pull("ada/cart")
    assert read_policy(folder).policy_version == 4
    offline(hub, monkeypatch)
    assert pull("ada/cart") == folder


def test_a_file_that_is_larger_than_the_hub_says_is_refused(hub: HubServer, monkeypatch: pytest.MonkeyPatch) -> None:
    run_of(Path("run"), 4)
    assert push(["run", "ada/cart"]) == 0
    hub.sizes["manifest.json"] = 10
    monkeypatch.setitem(hub_module.LIMITS, "manifest.json", 100)
    with pytest.raises(HubError, match=r"manifest\.json of ada/cart is larger than the Hub says"):
        pull("ada/cart")


@pytest.mark.parametrize("file", sorted(POLICY))
def test_a_changed_file_is_damaged(hub: HubServer, file: str) -> None:
    run_of(Path("run"), 4)
    assert push(["run", "ada/cart"]) == 0
    files = hub.files("ada/cart")
    hub.repositories["ada/cart"].commit({**files, file: files[file][:-1] + bytes([files[file][-1] ^ 1])})
    with pytest.raises(DamagedError):
        find_policy(pull("ada/cart"))


def test_a_large_video_is_left_out_and_folders_of_this_machine_are_named(
    hub: HubServer, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    Path("older").mkdir()
    run = save(run_of(Path("run"), 3), GAME, 4, league={"opponents": {"random": 0.0, "older": 0.0}})
    (run / "replay.mp4").write_bytes(b"a video")
    monkeypatch.setattr(hub_upload, "_MAX_VIDEO_BYTES", 3)
    with caplog.at_level(logging.WARNING):
        assert push(["run", "ada/cart"]) == 0
    assert "replay.mp4" not in hub.files("ada/cart")
    assert "names become public in config.toml and metrics.csv: older" in caplog.text
