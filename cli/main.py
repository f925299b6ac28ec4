"""`daedalus COMMAND`: finds the command and runs it. Imports nothing that the command does not need."""

import os
import sys

from daedalus.cli.command_table import COMMANDS
from daedalus.launch.logs import say
from daedalus.launch.process_lifecycle import exit_on_thread_exceptions, exit_status, interrupts_held

USAGE = """\
usage: daedalus COMMAND ...

Actor-critic reinforcement learning with one learner and any number of actors, on any machines.

on this machine:
  train      start a learner and actors, show their progress, evaluate the result
  resume     continue a run from its newest checkpoint
  sweep      train runs of several settings and seeds, and compare them
  check      play an environment with random actions, and report its faults, its speed and what train would choose
  settings   print the settings of a run with their defaults, limits and meanings

on several machines, one process at a time:
  learner    own the weights, and train them on the rollouts of actors
  actor      play environments for a learner; needs only its address
  router     connect learner and actors at a fixed address
  status     show the state of a learner and its actors
  drain      ask actors to leave after their current rollout
  gateway    show a run on a web page, and connect actors in any language
  exporter   export the status as Prometheus metrics
  certs      create certificates for encrypted connections

after training:
  evaluate   play episodes with the policy of a run, or record a video
  plot       draw the learning curves of one or more runs
  compare    print a table of groups of runs, with intervals
  report     write one HTML file about one or more runs
  push       upload the policy of a run to the Hugging Face Hub

for the shell:
  completion print a script that completes commands, options and presets

`daedalus COMMAND --help` describes a command, and `daedalus --version` prints the version.
To start: daedalus train cartpole"""


def main() -> int:
    """Run the command that the command line names, and return its exit status."""
    return exit_status(_run)


def _run() -> int:
    arguments = sys.argv[1:]
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(USAGE)
        return 0 if arguments else 2
    if arguments[0] == "--version":
        from daedalus import __version__

        print(f"daedalus {__version__}")
        return 0
    command, rest = arguments[0], arguments[1:]
    if command not in COMMANDS:
        import difflib

        near = difflib.get_close_matches(command, COMMANDS, 1, 0.5)
        hint = f"did you mean {near[0]}?" if near else "`daedalus --help` lists the commands"
        say(f"daedalus: unknown command {command!r}: {hint}", sys.stderr)
        return 2
    if COMMANDS[command].function:
        exit_on_thread_exceptions()
        return COMMANDS[command].run(rest)
    line = [sys.executable, "-P", "-m", f"daedalus.cli.commands.{command}", *rest]
    if sys.platform == "win32" or not hasattr(os, "execv"):  # Windows would return to the shell at once
        import subprocess

        return subprocess.run(line, check=False).returncode
    # The command replaces this process, so signals reach it and its exit status is returned.
    with interrupts_held():
        os.execv(sys.executable, line)
