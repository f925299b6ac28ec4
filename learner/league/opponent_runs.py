"""Opponents that are policies of other runs: read from a run directory or from the Hub, and copied into the run.

The copy stays the opponent: the other run may go on, and a rating belongs to one policy.
"""

import hashlib
import logging
from pathlib import Path

from daedalus.learner.run.settings import SettingsError
from daedalus.policy.saving.hub import HubError, pull
from daedalus.policy.saving.saved_policy import NoPolicyError, SavedPolicy, export_policy, find_policy, read_policy
from daedalus.policy.saving.sealed import DamagedError

_logger = logging.getLogger(__name__)


def opponent_run(name: str, folder: Path) -> SavedPolicy:
    """Return the policy of another run.

    Args:
      name: a run directory, one of its checkpoints, or USER/NAME on the Hub.
      folder: has the copies of this run, or will have them.

    Raises SettingsError, which names the opponent.
    """
    copy = folder / f"opponent_{hashlib.sha256(name.encode()).hexdigest()[:16]}"
    try:
        if copy.exists():
            return read_policy(copy)
        source, (owner, _, rest) = Path(name), name.partition("/")
        if not source.exists() and rest and "/" not in rest and owner not in (".", "..", "~", ""):
            source = pull(name)
        policy = find_policy(source)
        export_policy(policy.directory, copy)
    except (HubError, NoPolicyError, DamagedError) as error:
        again = f"; remove {copy} to read {name} again" if copy.exists() else ""
        raise SettingsError(f"league.opponents: {name} cannot be loaded: {error}{again}") from None
    except OSError as error:
        raise SettingsError(f"league.opponents: {name} cannot be copied to {copy}: {error.strerror or error}") from None
    _logger.info("opponent %s: policy version %d of %s", name, policy.policy_version, policy.directory)
    return policy
