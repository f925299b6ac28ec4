"""The commands of `daedalus`, in the order of its help, and where their code is. Imports none of them."""

import argparse
import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Command:
    """Where the code of one command is, each as `module:function` in daedalus.cli."""

    parser: str
    function: str = ""  # with the words after the command; none: it is a process of its own

    def make_parser(self) -> argparse.ArgumentParser:
        """Return the parser of the command."""
        return _found(self.parser)()

    def run(self, arguments: list[str]) -> int:
        """Run the command in this process and return its exit status."""
        run: Callable[[list[str]], int] = _found(self.function)
        return run(arguments)


def _found(place: str) -> Any:
    module, _, function = place.partition(":")
    return getattr(importlib.import_module(f"daedalus.cli.{module}"), function)


COMMANDS = {
    "train": Command("commands.train:train_parser", "commands.train:train"),
    "resume": Command("commands.train:resume_parser", "commands.train:resume"),
    "sweep": Command("commands.sweep:parser", "commands.sweep:sweep"),
    "check": Command("commands.check:parser", "commands.check:check"),
    "settings": Command("commands.settings:parser", "commands.settings:settings"),
    "learner": Command("commands.learner:parser"),
    "actor": Command("commands.actor:parser"),
    "router": Command("commands.router:parser", "commands.router:router"),
    "status": Command("commands.status:parser", "commands.status:status"),
    "drain": Command("commands.drain:parser", "commands.drain:drain"),
    "gateway": Command("commands.gateway:parser"),
    "exporter": Command("commands.exporter:parser", "commands.exporter:exporter"),
    "certs": Command("commands.certs:parser", "commands.certs:certs"),
    "evaluate": Command("commands.evaluate:parser"),
    "plot": Command("commands.plot:parser", "commands.plot:plot"),
    "compare": Command("commands.compare:parser", "commands.compare:compare"),
    "report": Command("commands.report:parser", "commands.report:report"),
    "push": Command("commands.push:parser", "commands.push:push"),
    "completion": Command("commands.completion:parser", "commands.completion:completion"),
}
