"""The upload of a policy to the Hugging Face Hub: its files, its settings, its results and the model card."""

import json
import logging
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

from daedalus.analysis.model_card import model_card
from daedalus.analysis.recorded_run import SECONDS, RunRecord, read_record
from daedalus.analysis.run_archive import secret_settings
from daedalus.analysis.run_selection import one_run
from daedalus.learner.run.run_directory import CONFIG, EVALUATION, METRICS, VERSIONS
from daedalus.learner.run.run_files import RunDataError
from daedalus.policy.saving.hub import LIMITS, HubError, check_repository, hub_api, hub_errors
from daedalus.policy.saving.saved_policy import SavedPolicy, export_policy, find_policy
from daedalus.policy.saving.sealed import MANIFEST
from daedalus.transport.private_address import private_folder

_logger = logging.getLogger(__name__)

CARD, REPLAY = "README.md", "replay"
_OURS = {*LIMITS, CARD, CONFIG, METRICS, EVALUATION, VERSIONS, f"{REPLAY}.mp4", f"{REPLAY}.gif"}
_OF_THE_HUB = {".gitattributes"}
_WAIT_SECONDS = 60.0  # for an answer of the Hub
_MAX_VIDEO_BYTES = 64 << 20
_MAX_TEXT_BYTES = 64 << 20


def push(directory: Path, repository: str, *, private: bool) -> str:
    """Upload the policy of a run, the best or else the newest, as one commit. Return the address of the commit.

    Args:
      directory: the run directory.
      repository: USER/NAME; it is created if it does not exist.
      private: create it as a private repository; an existing one must be private.

    Raises HubError, RunDataError, NoPolicyError, DamagedError.
    """
    api = hub_api()  # first: without the library, nothing can be done
    check_repository(repository)
    record = read_record(one_run(directory), [SECONDS])
    policy = find_policy(directory)
    record = _with_matching_evaluation(record, policy)
    if api.token is None:
        from huggingface_hub import get_token

        if get_token() is None:
            raise HubError("not logged in to the Hub: log in with `hf auth login`, or set HF_TOKEN")
    files = policy_files(record, policy, repository)
    from huggingface_hub import CommitOperationAdd, CommitOperationDelete, get_session

    get_session().timeout = _WAIT_SECONDS  # of each request; without it, the library waits for ever
    with hub_errors(repository):
        api.create_repo(repository, private=private or None, exist_ok=True)
        info = api.model_info(repository)
        present = {file.rfilename for file in info.siblings or []}
        _check_ours(repository, present)
        if private and not info.private:  # `private` of create_repo has no effect on one that exists
            raise HubError(
                f"{repository} is public: make it private in its settings on the Hub, or choose another name"
            )
        additions = [CommitOperationAdd(path_in_repo=name, path_or_fileobj=data) for name, data in files.items()]
        stale = [CommitOperationDelete(path_in_repo=name) for name in sorted((present & _OURS) - files.keys())]
        commit = api.create_commit(
            repository, [*additions, *stale], commit_message=f"Policy version {policy.policy_version}"
        )
    return commit.commit_url


def policy_files(record: RunRecord, policy: SavedPolicy, repository: str) -> dict[str, bytes]:
    """Return the files of the repository by their names. Raises DamagedError, HubError, RunDataError."""
    for name in secret_settings(policy.spec):
        raise HubError(
            f"{name} holds a password or a token, which would be published: train without it in the settings (let "
            "the environment read it from a variable), and push that run"
        )
    if folders := [name for name in policy.spec.league.opponents if Path(name).is_dir()]:
        _logger.warning(
            "league.opponents names folders of this machine, and their names become public in %s and %s: %s",
            CONFIG,
            METRICS,
            ", ".join(folders),
        )
    with private_folder() as folder:
        exported = Path(folder) / "policy"
        export_policy(policy.directory, exported)
        files = {name: (exported / name).read_bytes() for name in LIMITS}
    for name, data in files.items():
        if len(data) > LIMITS[name]:
            raise HubError(f"{name} has {len(data):,} bytes, and `daedalus evaluate --from-hub` reads {LIMITS[name]:,}")
    video = None
    if record.video is not None and record.video.size > _MAX_VIDEO_BYTES:
        _logger.warning("%s is larger than %d MiB and is not uploaded", record.video.path, _MAX_VIDEO_BYTES >> 20)
    elif record.video is not None:
        video = f"{REPLAY}{record.video.path.suffix.lower()}"  # the name that the Hub shows on the page
        files[video] = record.video.path.read_bytes()
    files |= _texts(record.directory, (CONFIG, METRICS))
    if record.evaluation is not None:
        files[EVALUATION] = _json(record.evaluation.model_dump(mode="json"))
    own = {name: value for name, value in record.versions.items() if not name.startswith("init_from")}  # a path
    files[VERSIONS] = _json(own)
    files[CARD] = model_card(record, policy.spec, repository, video).encode()
    return files


def _json(content: dict[str, Any]) -> bytes:
    return json.dumps(content, indent=2).encode() + b"\n"


def _texts(directory: Path, names: Iterable[str]) -> dict[str, bytes]:
    """Return the contents of files that exist. A link could lead to any file of the user's, and is refused."""
    found = {}
    for name in names:
        path = directory / name
        if path.is_symlink():
            raise RunDataError(f"{path} is a link to another file, which is not uploaded: put the file in its place")
        if path.is_file():
            if path.stat().st_size > _MAX_TEXT_BYTES:
                raise RunDataError(f"{path} is larger than {_MAX_TEXT_BYTES >> 20} MiB: make it shorter, or remove it")
            found[name] = path.read_bytes()
    return found


def _with_matching_evaluation(record: RunRecord, policy: SavedPolicy) -> RunRecord:
    """Return the record, without the evaluation of another policy of the run."""
    evaluation, how = record.evaluation, record.record_command
    if evaluation is None:
        _logger.warning("no evaluation is recorded, and the model card has no results; before the push: %s", how)
    elif evaluation.policy_version != policy.policy_version:
        _logger.warning(
            "the recorded evaluation is of policy version %d, the policy is version %d, and the model card has no "
            "results; before the push: %s",
            evaluation.policy_version,
            policy.policy_version,
            how,
        )
        return replace(record, evaluation=None)
    return record


def _check_ours(repository: str, present: set[str]) -> None:
    """Raise HubError if a repository has files of something else, whose model card would be replaced."""
    if present - _OF_THE_HUB and MANIFEST not in present:
        raise HubError(f"{repository} has files that are not of a policy of Daedalus: choose another name")
