"""Attack: messages of hundreds of megabytes, to a router that denies them and to a learner.

    python -m benchmarks.attack.large_messages

Zenoh assembles a message in memory before anybody can refuse it. The attack sends 700 MB to a router that denies it to
the sender, and three queries of 400 MB to a learner on loopback. Both must stay small and keep working.
"""

import datetime
import sys
from contextlib import closing
from pathlib import Path

from benchmarks.attack.verdict import Verdict
from benchmarks.chaos.scene import ENDLESS, resident_mib, scene
from daedalus.launch.certificates import CertificateFolder, Identity
from daedalus.protocol import keys
from daedalus.protocol.codec import decode
from daedalus.protocol.limits import Limits
from daedalus.transport.credentials import load
from daedalus.transport.zenoh_transport import connect

_LIFETIME = datetime.timedelta(days=365)
_MEGABYTE = 10**6
_MOST_GROWTH_MIB = 200.0  # three messages of 64 MiB, the largest that is received


def large_messages() -> Verdict:
    """Send the messages, and return whether router and learner stayed small and answer."""
    before, after = _router()
    learner_before, learner_after, answer = _learner()
    return Verdict(
        max(after - before, learner_after - learner_before) <= _MOST_GROWTH_MIB and "has not joined" in answer,
        f"700 MB denied: router {before:.0f} -> {after:.0f} MiB; 3 queries of 400 MB: learner {learner_before:.0f} -> "
        f"{learner_after:.0f} MiB; 40 MB are answered {answer!r}; both work afterwards",
    )


def _router() -> tuple[float, float]:
    """Return the peak memory of a router before and after the attack."""
    with scene() as here:
        certificates = here.folder / "certs"
        CertificateFolder.create(certificates, [], _LIFETIME).issue([Identity("actor", "arm")], _LIFETIME)
        address = here.address.replace("tcp/", "tls/")
        running = here.start("router", "--listen", address, "--tls", certificates / "router")
        running.expect("listening")
        with (
            closing(connect([address], load(certificates / "learner", "learner"))) as learner,
            closing(connect([address], load(certificates / "actor-arm", "actor"))) as actor,
        ):
            learner.serve(keys.join("r", "arm"), lambda request: request.reply(b"welcome"))
            here.wait("an answer", lambda: actor.query(keys.join("r", "arm"), timeout=5.0))
            before = _peak_mib(running.process.pid)
            actor.query(keys.rollouts("r", "box"), bytes(700 * _MEGABYTE), timeout=1.0)  # denied: another's name
            here.wait("an answer after the attack", lambda: actor.query(keys.join("r", "arm"), timeout=5.0))
            return before, _peak_mib(running.process.pid)


def _learner() -> tuple[float, float, str]:
    """Return the peak memory of a learner before and after the attack, and its answer to 40 MB of a stranger."""
    with scene() as here:
        running = here.start("learner", "cartpole", "--listen", here.address, "--run-dir", "run", *ENDLESS)
        here.start("actor", "--connect", here.address, "--name", "honest")
        here.wait_for_training("honest")
        pid = running.process.pid
        before, payload = _peak_mib(pid), bytes(400 * _MEGABYTE)
        with closing(connect([here.address])) as stranger:
            for key_of in (keys.join, keys.rollouts, keys.evaluations):
                stranger.query(key_of("run", "stranger"), payload, timeout=1.0)
            refusal = stranger.query(keys.rollouts("run", "stranger"), payload[: 40 * _MEGABYTE], timeout=60.0)
        here.wait_for_training("honest")
        answer = decode(refusal[0], Limits()) if refusal else None
        return before, _peak_mib(pid), getattr(answer, "reason", "none")


def _peak_mib(pid: int) -> float:
    """Return the largest resident memory of a process so far."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmHWM"):
            return int(line.split()[1]) / 1024
    return resident_mib(pid)


if __name__ == "__main__":
    verdict = large_messages()
    print(verdict)
    sys.exit(0 if verdict.held else 1)
