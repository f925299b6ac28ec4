"""Trace which of our files a rollout passes, and write them into docs/architecture.md. `make docs-reference` runs this.

A learner and an actor train in one process, over the transport in memory. The functions that count are those that one
of three threads enters during at least every second rollout: waiting, logging and all else that goes by the clock is
left out, so that the trace is the same on every machine. With --check nothing is written: small differences pass,
because a moved function is no reason to change a page.
"""

import argparse
import collections
import functools
import importlib.util
import re
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from types import CodeType, FrameType, ModuleType
from typing import Any

import gymnasium
from gymnasium.envs.classic_control import CartPoleEnv

from daedalus.actor.session.actor_config import ActorConfig
from daedalus.actor.session.actor_service import ActorService
from daedalus.learner.run.settings import choose_algorithm, override, read_preset, run_spec
from daedalus.transport.memory import MemoryNetwork, MemoryTransport

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "architecture.md"
BEGIN, END = "<!-- generated: trace of a rollout -->", "<!-- end of generated -->"
THREADS = {  # by the name that they have while they are traced
    "actor": "The actor's main thread, which in this process also runs the learner's handlers",
    "intake": "The learner's intake",
    "learner": "The learner's main thread",
}

_PACKAGE = f"{ROOT / 'daedalus'}/"
_ROWS, _ENVIRONMENTS = 16, 16
_ROLLOUTS = range(20, 50)  # that are traced: before them, buffers are made and the policy's code is recorded
_SETTINGS = [
    *("environment.id=TracedCartPole-v1", "collection.actors=1", f"collection.rollout_length={_ROWS}"),
    *(f"collection.envs_per_actor={_ENVIRONMENTS}", "training.batch_rollouts=1", "training.target_return=none"),
    *(f"training.env_steps={(_ROLLOUTS.stop + 10) * _ROWS * _ENVIRONMENTS}", "service.log_seconds=1e6"),
    *("service.checkpoint_seconds=1e6", "evaluation.seconds=none"),
]
_MOST_FILES, _MOST_FUNCTIONS = 4, 0.05  # differences that --check accepts: files, and a share of the functions

Function = tuple[str, str]  # its file, and its name: `function` or `Class.function`


class Tracer:
    """The functions of ours that each thread enters while it records, and where they are called."""

    def __init__(self) -> None:
        self._recording = False
        self._steps = 0
        # By thread: the rollouts during which a function is entered. A row of metrics calls some of them many times.
        self._rollouts: dict[int, dict[Function, set[int]]] = collections.defaultdict(
            lambda: collections.defaultdict(set)
        )
        self._places: dict[int, dict[Function, tuple[int, ...]]] = collections.defaultdict(dict)
        self._around: dict[int, list[FrameType]] = {}  # the frames of each thread when recording begins
        self._threads: dict[int, str] = {}

    def on_call(self, frame: FrameType, event: str, _argument: Any) -> None:
        """See sys.setprofile."""
        if self._recording and event == "call" and (function := _ours(frame.f_code)):
            self._count(threading.get_ident(), function, frame)

    def on_step(self) -> None:
        """Count a step of an environment; record while a rollout is played that is to be traced."""
        self._steps += 1
        recording = self._steps // (_ROWS * _ENVIRONMENTS) in _ROLLOUTS
        if recording and not self._recording:
            self._threads = {each.ident: each.name for each in threading.enumerate() if each.ident is not None}
            self._around = {thread: list(_callers(frame)) for thread, frame in sys._current_frames().items()}
        elif self._recording and not recording:
            # The loops, whose calls have not ended in all this time, are on the way of every rollout too.
            for thread, frame in sys._current_frames().items():
                for each in _callers(frame):
                    if each in self._around.get(thread, []) and (function := _ours(each.f_code)):
                        self._count(thread, function, each)
                        self._rollouts[thread][function] |= {*_ROLLOUTS}
        self._recording = recording

    def passed(self) -> dict[str, list[Function]]:
        """Return the functions that each thread entered for rollouts, in the order of the lines that call them."""
        found: dict[str, list[Function]] = {name: [] for name in THREADS}
        for thread, rollouts in self._rollouts.items():
            if (name := self._threads.get(thread, "")) in found:
                often = [function for function, numbers in rollouts.items() if 2 * len(numbers) >= len(_ROLLOUTS)]
                found[name] = sorted(often, key=self._places[thread].__getitem__)
        return found

    def _count(self, thread: int, function: Function, frame: FrameType) -> None:
        self._rollouts[thread][function].add(self._steps // (_ROWS * _ENVIRONMENTS))
        place = tuple(each.f_lineno for each in _callers(frame.f_back))[::-1]
        self._places[thread][function] = min(place, self._places[thread].get(function, place))


@functools.cache
def _ours(code: CodeType) -> Function | None:
    """Return the function of some code, or None if it is none of ours, or one without a name."""
    if not code.co_filename.startswith(_PACKAGE) or code.co_name.startswith("<"):
        return None
    return str(Path(code.co_filename).resolve().relative_to(ROOT)), code.co_qualname.replace(".<locals>", "")


def _callers(frame: FrameType | None) -> Iterator[FrameType]:
    """Yield a frame and those of its callers."""
    while frame is not None:
        yield frame
        frame = frame.f_back


def trace() -> dict[str, list[Function]]:
    """Train for some rollouts and return the functions that they passed, by thread."""
    tracer = Tracer()

    class TracedCartPole(CartPoleEnv):
        def step(self, action: Any) -> Any:
            tracer.on_step()
            return super().step(action)

    gymnasium.register("TracedCartPole-v1", entry_point=lambda **arguments: TracedCartPole(**arguments))
    settings = read_preset("cartpole")
    choose_algorithm(settings, "impala")
    override(settings, _SETTINGS)
    spec, example = run_spec(settings), _one_process()
    network, stop = MemoryNetwork(), threading.Event()
    threading.setprofile(tracer.on_call)
    try:
        with tempfile.TemporaryDirectory() as folder:
            directory = Path(folder) / "run"
            example.create(directory, spec)
            actor = threading.Thread(target=_play, args=(network, stop), name="actor")
            learner = threading.Thread(target=example.learn, args=(spec, directory, network, stop), name="learner")
            actor.start()
            learner.start()
            learner.join()
            stop.set()
            actor.join()
    finally:
        threading.setprofile(None)
    return tracer.passed()


def _play(network: MemoryNetwork, stop: threading.Event) -> None:
    transport = MemoryTransport(network)
    try:
        # The link would count as slow while every call is traced.
        ActorService(ActorConfig(name="actor", incarnation=1, link="lan"), transport, stop).run()
    finally:
        transport.close()


def _one_process() -> ModuleType:
    """Return examples/one_process.py, which runs a learner over the transport in memory."""
    found = importlib.util.spec_from_file_location("one_process", ROOT / "examples" / "one_process.py")
    assert found is not None
    assert found.loader is not None
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    return module


def section(traced: dict[str, list[Function]]) -> str:
    """Return the trace as Markdown: the files that each thread passes, with the number of functions."""
    functions = {each for passed in traced.values() for each in passed}
    files = {file for file, _ in functions}
    lines = [
        f"One rollout passes **{len(functions)} functions in {len(files)} files**, in the order of the calls. "
        "Each file has\nits number of functions. It is measured with CartPole, `impala` and the transport in memory."
    ]
    for thread, passed in traced.items():
        counts = collections.Counter(file for file, _ in passed)
        lines += ["", f"{THREADS[thread]}: {len(passed)} functions in {len(counts)} files.", ""]
        lines += [f"- `{file}`: {count}" for file, count in counts.items()]
    return "\n".join(lines)


def faults(page: str, traced: dict[str, list[Function]]) -> list[str]:
    """Return how a page differs from the trace: too many files or functions, or a step that is not on the way."""
    found = []
    functions = {each for passed in traced.values() for each in passed}
    files, written = {file for file, _ in functions}, set(re.findall(r"^- `([\w/]+\.py)`: \d+$", page, re.MULTILINE))
    number = int(next(iter(re.findall(r"passes \*\*(\d+) functions", page)), "0"))
    if len(files ^ written) > _MOST_FILES:
        found += [f"the trace has a file that the page lacks: {file}" for file in sorted(files - written)]
        found += [f"the page has a file that the trace lacks: {file}" for file in sorted(written - files)]
    if abs(len(functions) - number) > _MOST_FUNCTIONS * len(functions):
        found.append(f"the page has {number} functions, and the trace {len(functions)}")
    for file, name in re.findall(r"^\d+\. `([\w/]+\.py)` `([\w.]+)`: ", page.partition("## A rollout's way")[2], re.M):
        if (file, name) not in functions:
            found.append(f"a step names {name} of {file}, which no rollout passes: correct the step by hand")
    return found


def main() -> int:
    """Write the trace into the page, or check the page; return the exit status."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--check", action="store_true", help="write nothing; exit with 1 if the page differs")
    options.add_argument("--functions", action="store_true", help="print every function of the trace")
    arguments = options.parse_args()
    page, traced = PAGE.read_text("utf-8"), trace()
    if arguments.functions:
        print("\n".join(f"{thread} {file} {name}" for thread, passed in traced.items() for file, name in passed))
    if arguments.check:
        found = faults(page, traced)
        found += [f"{PAGE.name} differs from the trace: run `make docs-reference`"] if found else []
        print(*found, sep="\n")
        return 1 if found else 0
    begin, _, rest = page.partition(BEGIN)
    PAGE.write_text(f"{begin}{BEGIN}\n\n{section(traced)}\n\n{END}{rest.partition(END)[2]}", "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
