"""The commands of `daedalus`: its help, and where their code is, in the same order. Imports none of them."""

import argparse
import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

USAGE = """\
usage: daedalus COMMAND ...

Actor-critic reinforcement learning with one learner and any number of actors, on any machines.

on this machine:
  train      start a learner and actors, show their progress, evaluate the result
  resume     continue a run from its newest checkpoint
  sweep      train runs of several settings and seeds, and compare them
  check      play an environment with random actions, and report its faults, its speed and what train would choose
  record     play an environment, and record the episodes as demonstrations
  settings   print the settings of a run with their defaults, limits and meanings

on several machines, one process at a time:
  learner    own the weights, and train them on the rollouts of actors
  actor      play environments for a learner; needs only its address
  router     connect learner and actors at a fixed address
  status     show the state of a learner and its actors
  stop       save a checkpoint of a run and end its learner
  checkpoint save a checkpoint of a run now
  drain      ask actors to leave after their current rollout
  gateway    show a run on a web page, and connect actors in any language
  exporter   export the status as Prometheus metrics
  certs      create certificates for encrypted connections

after training:
  evaluate   play episodes with the policy of a run, or record a video
  plot       draw the learning curves of one or more runs
  compare    print a table of groups of runs, with intervals
  report     write one HTML file about one or more runs
  runs       keep runs in order: list, tag, best, archive, restore, prune
  export     write the policy of a run as one ONNX file, for use without Daedalus
  push       upload the policy of a run to the Hugging Face Hub

for the shell:
  completion print a script that completes commands, options and presets

`daedalus COMMAND --help` describes a command, and `daedalus --version` prints the version.
To start: daedalus train cartpole"""


@dataclass(frozen=True, slots=True)
class Command:
    """Where the code of one command is, each as `module:function` in daedalus.cli."""

    parser: str
    function: str = ""  # with the words after the command; none: it is a process of its own

    def make_parser(self) -> argparse.ArgumentParser:
        """Return the parser of the command."""
        return _found(self.parser)()

    def load(self) -> Callable[[list[str]], int]:
        """Import the command, and return the function that runs it in this process and returns its exit status."""
        return _found(self.function)

    def run(self, arguments: list[str]) -> int:
        """Run the command in this process and return its exit status."""
        return self.load()(arguments)


def _found(place: str) -> Any:
    module, _, function = place.partition(":")
    return getattr(importlib.import_module(f"daedalus.cli.{module}"), function)


COMMANDS = {
    "train": Command("commands.train:train_parser", "commands.train:train"),
    "resume": Command("commands.train:resume_parser", "commands.train:resume"),
    "sweep": Command("commands.sweep:parser", "commands.sweep:sweep"),
    "check": Command("commands.check:parser", "commands.check:check"),
    "record": Command("commands.record:parser", "commands.record:record"),
    "settings": Command("commands.settings_command:parser", "commands.settings_command:settings"),
    "learner": Command("commands.learner:parser"),
    "actor": Command("commands.actor:parser"),
    "router": Command("commands.router:parser", "commands.router:router"),
    "status": Command("commands.status:parser", "commands.status:status"),
    "stop": Command("commands.orders:stop_parser", "commands.orders:stop"),
    "checkpoint": Command("commands.orders:checkpoint_parser", "commands.orders:checkpoint"),
    "drain": Command("commands.orders:drain_parser", "commands.orders:drain"),
    "gateway": Command("commands.gateway:parser"),
    "exporter": Command("commands.exporter:parser", "commands.exporter:exporter"),
    "certs": Command("commands.certs:parser", "commands.certs:certs"),
    "evaluate": Command("commands.evaluate:parser"),
    "plot": Command("commands.plot:parser", "commands.plot:plot"),
    "compare": Command("commands.compare:parser", "commands.compare:compare"),
    "report": Command("commands.report:parser", "commands.report:report"),
    "runs": Command("commands.runs:parser", "commands.runs:runs"),
    "export": Command("commands.export:parser", "commands.export:export"),
    "push": Command("commands.push:parser", "commands.push:push"),
    "completion": Command("commands.completion:parser", "commands.completion:completion"),
}
