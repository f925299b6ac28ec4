"""Attack: another user of the machine looks for a local run and publishes a forged snapshot to it.

    python -m benchmarks.attack.forged_snapshot

`daedalus train` starts a learner and actors. A stranger could publish to them over any TCP port where they listen, or
over their Unix socket, if it may be entered.
"""

import os
import subprocess
import sys
from contextlib import closing, suppress
from pathlib import Path

import numpy as np
from processes import listening_ports, processes_mentioning

from benchmarks.attack.verdict import Verdict
from benchmarks.chaos.scene import ENDLESS, scene
from daedalus.protocol import keys
from daedalus.protocol.codec import encode
from daedalus.protocol.messages import Snapshot
from daedalus.transport.interface import TransportError
from daedalus.transport.zenoh_transport import connect

_NOBODY = 65_534


def forged_snapshot() -> Verdict:
    """Look for an address of the run as a stranger, publish there, and return whether that was possible."""
    with scene() as here:
        train = here.start("train", "cartpole", "--run-dir", "run", *ENDLESS)
        address = train.expect(r" at (\S+); run directory").group(1)
        train.expect(r"updates .*/s")
        ports = {port for process in processes_mentioning(address) for port in listening_ports(process)}
        reached = [port for port in sorted(ports) if _publish(f"tcp/127.0.0.1:{port}")]
        entered = _may_enter(address)
        alive = train.process.poll() is None
    return Verdict(
        not reached and not entered and alive,
        f"a forged snapshot could be published over {len(reached)} of the run's {len(ports)} TCP ports; another "
        f"user {'can' if entered else 'cannot'} enter the folder of the run's socket",
    )


def _publish(address: str) -> bool:
    """Publish a forged snapshot at an address; return whether the run is there."""
    forged = Snapshot(learner_epoch=0, policy_version=1 << 40, program="", weights={"w": np.zeros(1, np.float32)})
    with suppress(TransportError), closing(connect([address])) as stranger:
        stranger.publish(keys.snapshots("run"), encode(forged))
        return bool(stranger.query(keys.status("run"), timeout=2.0))
    return False


def _may_enter(address: str) -> bool:
    """Return whether another user may enter the folder of a Unix socket. Without root, its mode tells."""
    path = Path("/" + address.partition("/")[2].lstrip("/"))
    if os.geteuid() == 0:
        return subprocess.run(["stat", path], user=_NOBODY, capture_output=True, check=False).returncode == 0
    return bool(path.parent.stat().st_mode & 0o077)


if __name__ == "__main__":
    verdict = forged_snapshot()
    print(verdict)
    sys.exit(0 if verdict.held else 1)
