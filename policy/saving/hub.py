"""Policies on the Hugging Face Hub: which files they have there, and how to pull them. Nothing of a file is executed.

huggingface_hub is an extra, imported on first use. A repository may contain anything: only the files of a policy are
pulled, by their names, after a check of their sizes. SealedDirectory checks their contents.
"""

import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from daedalus.policy.saving.regular_files import replace_text
from daedalus.policy.saving.saved_policy import POLICY_LIMITS
from daedalus.policy.saving.sealed import MANIFEST, MAX_MANIFEST_BYTES, SEAL
from daedalus.protocol.texts import bounded_text

if TYPE_CHECKING:
    from huggingface_hub import HfApi

LIMITS = {
    MANIFEST: MAX_MANIFEST_BYTES,
    SEAL: 1 << 10,
    **POLICY_LIMITS,
}  # size of each file in a repository, in bytes
LIBRARY = "daedalus-rl"
_ANSWER_SECONDS = 20.0
_INSTALL = f'the Hub needs huggingface-hub: pip install "{LIBRARY}[hub]"'
_LOG_IN = "log in with `hf auth login`, or set HF_TOKEN"


class HubError(Exception):
    """Error of the Hub, or of the way to it. The message is one line and says what to do."""


class RepositoryNameError(HubError):
    """The name of a repository does not have the form USER/NAME."""


def hub_api() -> "HfApi":
    """Return the client of the Hub. Raises HubError if huggingface_hub is not installed."""
    try:
        from huggingface_hub import HfApi
        from huggingface_hub.utils import disable_progress_bars
    except ImportError:
        raise HubError(_INSTALL) from None
    if not sys.stderr.isatty():
        disable_progress_bars()
    return HfApi(library_name=LIBRARY)


def check_repository(repository: str) -> None:
    """Raise RepositoryNameError unless the name has the form USER/NAME."""
    from huggingface_hub.errors import HFValidationError
    from huggingface_hub.utils import validate_repo_id

    try:
        validate_repo_id(repository)
        valid = repository.count("/") == 1
    except HFValidationError:
        valid = False
    if not valid:
        raise RepositoryNameError(
            f"{repository!r} is not the name of a repository: write USER/NAME, of letters, digits, - _ and ."
        )


def pull(repository: str, revision: str | None = None) -> Path:
    """Return a folder with the files of a policy on the Hub; `find_policy` reads it.

    The files are kept in the cache of huggingface_hub. If the Hub cannot be reached, they are taken from there.

    Args:
      repository: USER/NAME.
      revision: branch, tag or commit (default: the newest commit of the branch main).

    Raises HubError.
    """
    api = hub_api()
    check_repository(repository)
    try:
        with hub_errors(repository, revision):
            commit = _checked_commit(api, repository, revision)
    except UnreachableError as error:
        cached = _cached(api, repository, revision)
        if cached is None:
            raise HubError(f"{error.reason}, and this machine has no copy of {repository}: {error.remedy}") from None
        return cached
    with hub_errors(repository, revision):
        # Of the checked commit: a branch may have moved since, to files of any size.
        folder = _folder(repository, [Path(api.hf_hub_download(repository, name, revision=commit)) for name in LIMITS])
        if revision != commit:
            with suppress(OSError):  # a cache in an image that is read only
                _note_commit(folder, revision or "main", commit)
    return folder


class UnreachableError(HubError):
    """Error of a Hub that does not answer, or that this process may not ask."""

    def __init__(self, reason: str, remedy: str) -> None:
        super().__init__(f"{reason}: {remedy}")
        self.reason, self.remedy = reason, remedy


def _checked_commit(api: "HfApi", repository: str, revision: str | None) -> str:
    """Return the commit of a revision after a check of the sizes of its files. Raises HubError."""
    info = api.model_info(repository, revision=revision, files_metadata=True, timeout=_ANSWER_SECONDS)
    sizes = {file.rfilename: file.size for file in info.siblings or []}
    missing = [name for name in LIMITS if name not in sizes]
    if missing:
        raise HubError(
            f"{repository} has no file {missing[0]}: it is not a policy that `daedalus push` uploaded; check the name"
        )
    for name, limit in LIMITS.items():
        size = sizes[name]
        if not isinstance(size, int) or not 0 <= size <= limit:
            raise HubError(
                f"{name} of {repository} has {size} bytes, the limit is {limit:,}: it is not a policy of ours"
            )
    if not isinstance(info.sha, str) or re.fullmatch(r"[0-9a-f]{40}", info.sha) is None:
        raise HubError(f"the Hub names no commit of {repository}: try again later")
    return info.sha


def _note_commit(folder: Path, name: str, commit: str) -> None:
    """Note in the cache of huggingface_hub which commit a branch or tag stands for, as a download by name would."""
    note = folder.parents[1] / "refs" / name
    note.parent.mkdir(parents=True, exist_ok=True)
    replace_text(note, commit)


def _cached(api: "HfApi", repository: str, revision: str | None) -> Path | None:
    """Return the folder of a policy that was pulled before, or None."""
    from huggingface_hub.errors import EntryNotFoundError

    try:
        paths = [
            Path(api.hf_hub_download(repository, name, revision=revision, local_files_only=True)) for name in LIMITS
        ]
    except (EntryNotFoundError, OSError, ValueError):
        return None
    return _folder(repository, paths)


def _folder(repository: str, paths: list[Path]) -> Path:
    """Return the folder that the files are in, after a check of their real sizes."""
    for path in paths:
        if path.stat().st_size > LIMITS[path.name]:
            raise HubError(f"{path.name} of {repository} is larger than the Hub says: it is not a policy of ours")
    if len({path.parent for path in paths}) != 1:
        raise HubError(f"{repository} has changed meanwhile: try again")
    return paths[0].parent


@contextmanager
def hub_errors(repository: str, revision: str | None = None) -> Iterator[None]:
    """Raise HubError for the errors of the library, which have many lines and names."""
    import httpx2  # the HTTP client of huggingface_hub, whose errors it passes on
    from huggingface_hub import errors

    try:
        yield
    except errors.RevisionNotFoundError:
        raise HubError(f"{repository} has no revision {revision!r}: name a branch, a tag or a commit") from None
    except errors.GatedRepoError:
        raise HubError(f"{repository} is gated: ask for access on its page on the Hub, and {_LOG_IN}") from None
    except errors.RepositoryNotFoundError:
        raise HubError(
            f"there is no repository {repository} on the Hub, or it is private: check the name; for a private one, "
            f"{_LOG_IN}"
        ) from None
    except errors.LocalTokenNotFoundError:
        raise HubError(f"not logged in to the Hub: {_LOG_IN}") from None
    except errors.OfflineModeIsEnabled:
        raise UnreachableError("the Hub is not asked, because HF_HUB_OFFLINE is set", "unset HF_HUB_OFFLINE") from None
    except errors.HfHubHTTPError as error:
        status = error.response.status_code
        if status in (401, 403):
            raise HubError(
                f"the Hub refuses this for {repository} (status {status}): {_LOG_IN}, with a token that may do this"
            ) from None
        said = error.server_message or str(error).partition("\n")[0]
        raise HubError(f"the Hub answers with status {status}: {bounded_text(said)}; try again later") from None
    except errors.LocalEntryNotFoundError as error:
        raise UnreachableError(f"a file of {repository} cannot be downloaded ({_cause(error)})", "try again") from None
    except (ConnectionError, TimeoutError, httpx2.HTTPError) as error:
        reason = f"the Hub cannot be reached ({_cause(error)})"
        raise UnreachableError(reason, "check the network and HF_ENDPOINT") from None
    except (OSError, RuntimeError, ValueError) as error:  # RuntimeError: a large file could not be uploaded
        why = _cause(error) if error.__cause__ is None else f"{_cause(error)} ({_cause(error.__cause__)})"
        raise HubError(f"the Hub or its library failed: {why}; try again") from None


def _cause(error: BaseException) -> str:
    return bounded_text(str(error)) or type(error).__name__
