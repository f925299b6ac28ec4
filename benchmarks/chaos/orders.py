"""Learner, router and actors that start in every order, on hosts of their own, and a cut of most of the actors."""

import itertools
import json
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hosts import Host, Network, NoHostsError
from processes import Running

from benchmarks.chaos.scene import ENDLESS, LIMIT, FailedError, say, seconds
from benchmarks.slow_actors import MODULE, provide_environment

_NEAR, _FAR = 4, 12  # actors; the host of the far ones is cut off
_STEP_SECONDS = 0.02
_START_SECONDS = 3.0  # from one start to the next
_STATUS = Path(__file__).parents[2] / "tests" / "status_lines.py"
_ORDERS = tuple(itertools.permutations(("learner", "router", "actors")))


def orders(rounds: int) -> list[tuple[str, str]]:
    """Cut 12 of 16 actors of `a2c` off after each order of starts; in every second case the router was restarted."""
    missed, gap, back = [], [], []
    cases = [(order, restart) for restart in (False, True) for order in _ORDERS][: max(rounds, 1)]
    for number, (order, restart) in enumerate(cases):
        with tempfile.TemporaryDirectory() as folder:
            try:
                hosts = _Hosts(Path(folder))
            except NoHostsError as error:
                return [("not measured", str(error))]
            try:
                hosts.start(order, restart=restart)
                found = hosts.cut()
            finally:
                hosts.network.close()
        for values, value in zip((missed, gap, back), found, strict=True):
            values.append(value)
        kind = "router killed and restarted" if restart else "no restart"
        say(f"order {number + 1} of {len(cases)} ({', '.join(order)}; {kind}): missed after {missed[-1]:.2f} s")
    return [
        (
            f"{_FAR} of {_NEAR + _FAR} actors of a2c were cut off at once, and missed after",
            f"{seconds(missed)} starts: every order of learner, router and actors, half with a killed router",
        ),
        ("the longest time without an update of the others", seconds(gap)),
        ("all cut actors took part again, in the same process, after", seconds(back)),
    ]


class _Hosts:
    """Hosts of one run."""

    def __init__(self, folder: Path) -> None:
        self.network = Network(folder)
        provide_environment(folder)
        self._router, self._learner, self._near, self._far = (
            self.network.host(name) for name in ("router", "learner", "near", "far")
        )
        self._address = f"tcp/{self._router.address}:7447"
        self._running: dict[str, Running] = {}
        self._status: Running | None = None

    def start(self, order: tuple[str, ...], *, restart: bool) -> None:
        """Start the processes in an order and wait until all actors take part; then `restart` the router."""
        starts = {"learner": self._start_learner, "router": self._start_router, "actors": self._start_actors}
        for name in order:
            starts[name]()
            time.sleep(_START_SECONDS)
        self._status = self._learner.run(sys.executable, _STATUS, self._address)
        self._wait("all actors", lambda: self._alive() == _NEAR + _FAR)
        if restart:
            self._running["router"].process.kill()
            self._running["router"].wait()
            time.sleep(_START_SECONDS)
            self._start_router()
            time.sleep(_START_SECONDS)
            self._wait("all actors", lambda: self._alive() == _NEAR + _FAR)
        self._wait_for_update()

    def cut(self) -> tuple[float, float, float]:
        """Cut the far host off for 15 s; return when its actors were missed, the gap in updates, and the return."""
        began = updated = time.monotonic()
        updates, gap, missed_after = self._newest()["updates"], 0.0, 0.0
        self._far.unplug()
        while time.monotonic() < began + 15.0 or not missed_after:
            status, now = self._newest(), time.monotonic()
            if status.get("updates", updates) != updates:
                updates, gap, updated = status["updates"], max(gap, now - updated), now
            if not missed_after and self._alive() == _NEAR:
                missed_after = now - began
            if now > began + LIMIT:
                raise FailedError(f"{self._alive() - _NEAR} of {_FAR} cut actors are not missed after {LIMIT:g} s")
            time.sleep(0.02)
        gap = max(gap, time.monotonic() - updated)
        self._far.plug_in()
        began = time.monotonic()
        self._wait("all actors", lambda: self._alive() == _NEAR + _FAR)
        back = time.monotonic() - began
        self._wait_for_update()
        if any(each["lives"] != 1 for each in self._newest()["actors"]):
            raise FailedError("an actor was restarted")
        return missed_after, gap, back

    def _start_router(self) -> None:
        self._running["router"] = self._router.start("router", "--listen", self._address, "--insecure")

    def _start_learner(self) -> None:
        settings = (
            f"environment.kwargs={{seconds={_STEP_SECONDS}}}",
            "collection.envs_per_actor=1",
            "collection.rollout_length=8",
        )
        words = [word for setting in settings for word in ("--set", setting)]
        run = ("--env", f"{MODULE}:Slow-v0", "--algorithm", "a2c", "--actors", _NEAR + _FAR, "--run-dir", "run")
        where = ("--connect", self._address, "--insecure")
        self._running["learner"] = self._learner.start("learner", *run, *where, *words, *ENDLESS)

    def _start_actors(self) -> None:
        self._start_on(self._near, _NEAR)
        self._start_on(self._far, _FAR)

    def _start_on(self, host: Host, count: int) -> None:
        command = (sys.executable, "-m", "benchmarks.slow_actors", self._address, count, "--prefix", host.name)
        self._running[host.name] = host.run(*command)

    def _newest(self) -> dict[str, Any]:
        """Return the newest status, or an empty one while the learner does not answer."""
        lines = self._status.lines if self._status else []
        return json.loads(lines[-1]) if lines and lines[-1] else {}

    def _alive(self) -> int:
        return self._newest().get("actors_alive", -1)

    def _wait_for_update(self) -> None:
        before = self._newest().get("updates", 0)
        self._wait("an update", lambda: self._newest().get("updates", before) > before)

    def _wait(self, description: str, condition: Callable[[], bool]) -> None:
        deadline = time.monotonic() + LIMIT
        while not condition():
            if time.monotonic() > deadline:
                output = "\n".join(running.output[-2000:] for running in self._running.values())
                raise FailedError(f"{description}: not within {LIMIT:g} s\n{output}")
            time.sleep(0.02)
