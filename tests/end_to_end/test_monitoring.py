"""Test of the exporter process with a router, a learner and actors that join and die."""

import urllib.request
from collections.abc import Callable

from processes import Running, until
from prometheus_client.parser import text_string_to_metric_families

Start = Callable[..., Running]
ENDLESS = ("--set", "training.stop_when_solved=false", "--env-steps", 10**9)


def scrape(url: str) -> dict[tuple[str, str], float]:
    """Return the values by the names of sample and actor."""
    with urllib.request.urlopen(url, timeout=60) as answer:
        families = text_string_to_metric_families(answer.read().decode())
        return {(each.name, each.labels.get("actor", "")): each.value for family in families for each in family.samples}


def test_the_exporter_serves_metrics_of_the_present_learner_and_actors_only(start: Start, address: str) -> None:
    exporter = start("exporter", "--connect", address, "--listen", "127.0.0.1:0")
    url = exporter.expect(r"http://\S+").group()
    assert scrape(url) == {("daedalus_up", ""): 0.0}
    start("router", "--listen", address)
    learner = start("learner", "cartpole", "--connect", address, "--run-dir", "run", *ENDLESS)
    actors = {name: start("actor", "--connect", address, "--name", name, "--envs", 4) for name in ("a", "b")}
    env_steps = "daedalus_actor_env_steps_total"
    until(lambda: all(scrape(url).get((env_steps, name), 0.0) > 0.0 for name in actors))
    samples = scrape(url)
    assert (samples["daedalus_up", ""], samples["daedalus_healthy", ""]) == (1.0, 1.0)
    assert samples["daedalus_env_steps_total", ""] > 0.0
    actors["a"].process.kill()
    until(lambda: (env_steps, "a") not in scrape(url))
    assert {actor for _, actor in scrape(url) if actor} == {"b"}
    learner.process.kill()
    until(lambda: scrape(url) == {("daedalus_up", ""): 0.0})
    exporter.process.terminate()
    assert exporter.wait() == 0
