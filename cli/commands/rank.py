"""Rank 1 or higher of a learner. `daedalus learner --processes N` starts this command; nobody else does."""

import argparse
import os
import shutil
import sys
from pathlib import Path

from daedalus.cli.arguments import add_allow_module, add_logging
from daedalus.cli.ranks import follow
from daedalus.launch.logs import configure_logging
from daedalus.launch.process_lifecycle import exit_on_thread_exceptions, exit_status, exit_with_parent, stop_on_signals
from daedalus.learner.ranks.meeting import Meeting
from daedalus.learner.training.allocator import keep_freed_memory
from daedalus.policy.user_modules import UserModules


def main() -> int:
    """Run the command and return its exit status."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--rank", type=int, required=True)
    options.add_argument("--processes", type=int, required=True)
    options.add_argument("--folder", type=Path, required=True)
    options.add_argument("--exit-with-parent", action="store_true")
    add_allow_module(options, "the run")
    add_logging(options)
    arguments = options.parse_args()
    keep_freed_memory()
    stop = stop_on_signals()
    exit_with_parent(stop)
    configure_logging(arguments.log_level, as_json=arguments.log_json, process=f"learner, rank {arguments.rank}")
    meeting = Meeting(
        rank=arguments.rank,
        number=arguments.processes,
        local_rank=arguments.rank,
        folder=arguments.folder,
        on_this_machine=True,
    )
    status = follow(meeting, None, UserModules(frozenset(arguments.allow_module), "the learner"), stop)
    shutil.rmtree(arguments.folder, ignore_errors=True)  # rank 0 may have been killed
    return status


if __name__ == "__main__":
    exit_on_thread_exceptions()
    status = exit_status(main)
    sys.stderr.flush()
    os._exit(status)  # it holds nothing that has to be closed, and rank 0 waits for it
