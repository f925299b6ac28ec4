"""Many actors in one process, each with a session of its own, in environments that mostly sleep.

    python -m benchmarks.slow_actors ADDRESS COUNT --link auto

The actors start within --stagger seconds. Each that ends prints `ended NAME finished` or `ended NAME stopped`. A signal
ends all.
"""

import argparse
import random
import secrets
import shutil
import sys
import threading
from pathlib import Path

from daedalus.actor.session.actor_config import ActorConfig, LinkChoice
from daedalus.actor.session.actor_service import ActorService
from daedalus.launch.process_lifecycle import exit_on_thread_exceptions, stop_on_signals
from daedalus.policy.user_modules import UserModules
from daedalus.transport.connecting import connect_with_retry

MODULE = "slow_environment"
_PRINTING = threading.Lock()
_FILE = Path(__file__).parents[1] / "tests" / f"{MODULE}.py"


def provide_environment(folder: Path) -> None:
    """Copy the module of the environment `slow_environment:Slow-v0` into a folder that processes start in."""
    shutil.copy(_FILE, folder)


def play(address: str, name: str, link: LinkChoice, delay: float, stop: threading.Event) -> None:
    """Run one actor."""
    if stop.wait(delay):
        return
    transport = connect_with_retry([address], stop)
    if transport is None:
        return
    try:
        config = ActorConfig(
            name=name,
            incarnation=secrets.randbits(62),
            link=link,
            modules=UserModules(allowed=frozenset({MODULE})),
        )
        finished = ActorService(config, transport, stop).run()
        with _PRINTING:  # `print` writes the end of the line separately
            print(f"ended {config.name} {'finished' if finished else 'stopped'}", flush=True)
    finally:
        transport.close()


def main() -> int:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("address")
    options.add_argument("count", type=int)
    options.add_argument("--link", choices=("auto", "lan", "wan"), default="auto")
    options.add_argument("--prefix", default="actor", help="of the names")
    options.add_argument("--stagger", type=float, default=0.0, metavar="SECONDS")
    parsed = options.parse_args()
    sys.path.insert(0, "")
    stop, choose = stop_on_signals(), random.Random(1)
    threads = []
    for number in range(parsed.count):
        arguments = (
            parsed.address,
            f"{parsed.prefix}-{number}",
            parsed.link,
            choose.uniform(0.0, parsed.stagger),
            stop,
        )
        threads.append(threading.Thread(target=play, args=arguments, daemon=True))
        threads[-1].start()
    for thread in threads:
        while thread.is_alive():
            thread.join(0.1)
    return 0


if __name__ == "__main__":
    exit_on_thread_exceptions()
    sys.exit(main())
