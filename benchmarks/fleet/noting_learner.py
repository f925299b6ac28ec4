"""Learner that records when it publishes: `python -m benchmarks.fleet.noting_learner FILE ARGUMENTS`.

FILE gets lines of `policy_version seconds`, on the monotonic clock, which all processes of this machine share.
"""

import sys
import time

from daedalus.cli.commands.learner import main
from daedalus.learner.serving.snapshot_publisher import SnapshotPublisher

if __name__ == "__main__":
    notes = open(sys.argv.pop(1), "a", buffering=1)  # noqa: SIM115 - open until the process ends
    publish = SnapshotPublisher.publish

    def noted(self: SnapshotPublisher, policy_version: int, weights: dict) -> None:
        notes.write(f"{policy_version} {time.monotonic()}\n")
        publish(self, policy_version, weights)

    SnapshotPublisher.publish = noted  # type: ignore[method-assign] - only in this process
    sys.exit(main())
