"""Faults of the network: killed routers, and links that stall without an error."""

import time

from faults import StallingProxy

from benchmarks.chaos.scene import ENDLESS, FailedError, Scene, say, scene, seconds

_SMALL = ("--set", "collection.envs_per_actor=16")


def routers(count: int) -> list[tuple[str, str]]:
    """Kill and restart a router that learner and actors use."""
    back = []
    with scene() as here:
        router = here.router()
        here.start("learner", "cartpole", "--connect", here.address, "--run-dir", "run", *_SMALL, *ENDLESS)
        names = ["actor-a", "actor-b"]
        for name in names:
            here.start("actor", "--connect", here.address, "--name", name)
        for name in names:
            here.wait_for_training(name)
        for number in range(count):
            router.process.kill()
            router.wait()
            time.sleep(0.5 + number % 4)
            router = here.router()
            began = time.monotonic()
            for name in names:
                here.wait_for_training(name)
            back.append(time.monotonic() - began)
            say(f"router restart {number + 1} of {count}: all back after {back[-1]:.2f} s")
        status = here.status()
        assert status is not None
        lives = max(each.lives for each in status.actors)
    return [
        ("router restarts", f"{count}; processes per actor: {lives}"),
        ("rollouts of all actors were trained on after", seconds(back)),
    ]


def cuts(cut_seconds: float, rounds: int) -> list[tuple[str, str]]:
    """Stall links: those of four actors at once, and that of the learner to its router."""
    actors_back, learner_back, meanwhile = [], [], []
    with scene() as here:
        here.router()
        proxies = {name: StallingProxy(here.address) for name in ("learner", "a", "b", "c", "d")}
        try:
            link = proxies["learner"].address
            here.start("learner", "cartpole", "--connect", link, "--run-dir", "run", *_SMALL, *ENDLESS)
            here.start("actor", "--connect", here.address, "--name", "near")
            remote = ["a", "b", "c", "d"]
            for name in remote:
                here.start("actor", "--connect", proxies[name].address, "--name", name)
            for name in ("near", *remote):
                here.wait_for_training(name)
            for number in range(rounds):
                for name in remote:
                    proxies[name].stall()
                before = here.env_steps("near")
                time.sleep(cut_seconds)
                meanwhile.append((here.env_steps("near") - before) / cut_seconds)
                actors_back += _resume(here, {name: proxies[name] for name in remote})
                say(f"cut {number + 1} of {rounds}, four actors: back after {max(actors_back[-4:]):.2f} s")
                proxies["learner"].stall()
                time.sleep(cut_seconds)
                proxies["learner"].resume()
                began = time.monotonic()
                for name in ("near", *remote):
                    here.wait_for_training(name)
                learner_back.append(time.monotonic() - began)
                say(f"cut {number + 1} of {rounds}, the learner: back after {learner_back[-1]:.2f} s")
            status = here.status()
            assert status is not None
            if any(each.lives != 1 for each in status.actors):
                raise FailedError("an actor was restarted")
        finally:
            for proxy in proxies.values():
                proxy.close()
    return [
        (
            f"links half-open for {cut_seconds:g} s",
            f"{len(actors_back) + len(learner_back)}; no actor restarted; the actor on a good link went on with "
            f"{min(meanwhile):,.0f} env_steps/s or more",
        ),
        ("actors' links: trained on again after", seconds(actors_back)),
        ("the learner's link: all actors trained on again after", seconds(learner_back)),
    ]


def _resume(here: Scene, proxies: dict[str, StallingProxy]) -> list[float]:
    """Seconds until each actor contributes again."""
    before = {name: here.env_steps(name) for name in proxies}
    for proxy in proxies.values():
        proxy.resume()
    began, taken = time.monotonic(), {}

    def all_back() -> bool:
        for name in proxies:
            if name not in taken and here.env_steps(name) > before[name]:
                taken[name] = time.monotonic() - began
        return len(taken) == len(proxies)

    here.wait("all actors", all_back)
    return list(taken.values())
