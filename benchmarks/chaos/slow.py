"""Slow simulators that work: neither `status` nor the alerts may find fault with them."""

import re
import subprocess
import time
import urllib.request
from collections import defaultdict

from prometheus_client.parser import text_string_to_metric_families

from benchmarks.chaos.scene import ENDLESS, FailedError, say, scene
from benchmarks.running import COMMAND
from benchmarks.slow_actors import MODULE, provide_environment

_ROWS, _STEP_SECONDS, _LOOK_SECONDS = 1024, 0.1, 10.0
_NAMES = ("slow-0", "slow-1", "slow-2")


def slow(seconds: float) -> list[tuple[str, str]]:
    """Look at 3 actors of 100 ms a step and 102 s a rollout every 10 s, as an operator and as Prometheus do."""
    statuses, updates, rates, silence, lines = [], [], [], defaultdict[str, float](float), set[str]()
    with scene() as here:
        provide_environment(here.folder)
        allow = ("--allow-module", MODULE)
        settings = (f'environment.kwargs={{"seconds": {_STEP_SECONDS}}}', f"collection.rollout_length={_ROWS}")
        settings += ("collection.envs_per_actor=1",)
        words = [word for setting in settings for word in ("--set", setting)]
        here.start("learner", "--env", f"{MODULE}:Slow-v0", *allow, "--listen", here.address, *words, *ENDLESS)
        for name in _NAMES:
            here.start("actor", "--connect", here.address, "--name", name, *allow)
        exporter = here.start("exporter", "--connect", here.address, "--listen", "127.0.0.1:0")
        url = exporter.expect(r"http://\S+/metrics")[0]
        here.wait("all actors", lambda: (status := here.status()) and status.actors_alive == len(_NAMES))
        began = time.monotonic()
        while time.monotonic() < began + seconds:
            time.sleep(_LOOK_SECONDS)
            shown = subprocess.run(
                [*COMMAND, "status", "--connect", here.address], capture_output=True, text=True, check=False
            )
            statuses.append(shown.returncode)
            for line in shown.stdout.splitlines():
                if "PROBLEM" in line or "-bound:" in line or "the first batch" in line:
                    lines.add(re.sub(r"row [\d,]+", "row N", line.strip()))
            scraped = _scrape(url)
            updates.append(scraped["daedalus_updates_total"][0])
            rates += scraped["daedalus_updates_per_second"] if updates[-1] else []
            limits = scraped["daedalus_actor_silence_limit_seconds"]
            over = [
                value - limit for value, limit in zip(scraped["daedalus_actor_silence_seconds"], limits, strict=True)
            ]
            silence["longest"] = max(silence["longest"], *scraped["daedalus_actor_silence_seconds"])
            silence["over"] = max(silence["over"], *over, 0.0)
            say(f"{time.monotonic() - began:.0f} s: status {statuses[-1]}, {updates[-1]:g} updates, rates {rates[-1:]}")
    for line in sorted(lines):
        say(line)
    unhealthy, zero = sum(map(bool, statuses)), sum(rate == 0.0 for rate in rates)
    if unhealthy or zero or silence["over"] or not updates[-1]:
        raise FailedError(
            f"{unhealthy} of {len(statuses)} looks unhealthy, updates_per_second 0 in {zero} of {len(rates)} scrapes, "
            f"silence {silence['over']:.0f} s over its limit, {updates[-1]:g} updates: {'; '.join(sorted(lines))}"
        )
    return [
        (
            f"{len(_NAMES)} actors of {_STEP_SECONDS * 1000:g} ms a step, {_ROWS} rows a rollout",
            f"unhealthy in {unhealthy} of {len(statuses)} looks; {updates[-1]:g} updates",
        ),
        (
            "updates_per_second in the exporter, from the first update on",
            f"{min(rates):.3g} to {max(rates):.3g}, 0 in {zero} of {len(rates)} scrapes",
        ),
        ("the longest silence of an actor", f"{silence['longest']:.1f} s"),
    ]


def _scrape(url: str) -> defaultdict[str, list[float]]:
    """Return the values of the samples by name."""
    values = defaultdict[str, list[float]](list)
    with urllib.request.urlopen(url, timeout=10.0) as page:
        for family in text_string_to_metric_families(page.read().decode()):
            for sample in family.samples:
                values[sample.name].append(sample.value)
    return values
