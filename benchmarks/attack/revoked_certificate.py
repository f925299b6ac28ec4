"""Attack: an actor goes on with a certificate that was stolen, and revoked.

    python -m benchmarks.attack.revoked_certificate

Router, learner and the other actors keep running. The thief must lose its session and get no other, and must not come
back when its victim gets a new certificate of the same name.
"""

import contextlib
import datetime
import shutil
import sys
import time
from contextlib import closing

from benchmarks.attack.verdict import Verdict
from benchmarks.chaos.scene import ENDLESS, scene
from daedalus.launch.certificates import CertificateFolder, Identity
from daedalus.protocol import keys
from daedalus.transport.credentials import Credentials, load
from daedalus.transport.interface import RefusedError, Transport, TransportError
from daedalus.transport.zenoh_transport import connect

_LIFETIME = datetime.timedelta(days=365)
_MOST_SECONDS = 10.0


def revoked_certificate() -> Verdict:
    """Revoke the certificate of a connected thief; return whether it was shut out, and the others trained on."""
    with scene() as here:
        folder = CertificateFolder.create(here.folder / "certs", [], _LIFETIME)
        stolen, arm, box = here.folder / "stolen", Identity("actor", "arm"), Identity("actor", "box")
        folder.issue([arm, box], _LIFETIME)
        shutil.copytree(folder.directory / arm.folder, stolen)
        address = here.address.replace("tcp/", "tls/")
        router = here.start("router", "--listen", address, "--tls", folder.directory / "router")
        router.expect("listening")
        to = ("--connect", address, "--tls")
        learner = here.start("learner", "cartpole", *to, folder.directory / "learner", "--run-dir", "run", *ENDLESS)
        honest = here.start("actor", *to, folder.directory / box.folder)
        honest.expect("joined run")
        with closing(connect([address], load(stolen, "actor"))) as thief:
            here.wait("an answer to the thief", lambda: _answered(thief))
            folder.revoke([arm])
            taken = here.wait("the refusal of the thief", lambda: _refusal(thief))
            reason = _refusal(thief)
            folder.issue([arm], _LIFETIME)
            victim_folder = load(folder.directory / arm.folder, "actor")
            here.wait("the new certificate to be accepted", lambda: _connects(address, victim_folder))
            victim = here.start("actor", *to, folder.directory / arm.folder)
            victim.expect("joined run")
            again = _refusal(thief) and not _answered(thief)
        alive = all(running.process.poll() is None for running in (router, learner, honest, victim))
    return Verdict(
        taken <= _MOST_SECONDS and bool(again) and alive,
        f"refused {taken:.1f} s after the revocation ({reason.partition(': ')[2]}); router, learner and the other "
        "actor kept running; a new certificate of the same name works, the stolen one does not",
    )


def _connects(address: str, credentials: Credentials) -> bool:
    """Return whether the router knows a certificate: it reads the list of those in use every second or so."""
    try:
        connect([address], credentials).close()
    except TransportError:
        return False
    return True


def _answered(thief: Transport) -> bool:
    return bool(thief.query(keys.snapshots("run"), timeout=5.0))


def _refusal(thief: Transport) -> str:
    """Return why the thief gets no other session, or an empty string if it gets one."""
    with contextlib.suppress(TransportError):
        try:
            thief.reopen()
        except RefusedError as error:
            return str(error)
    time.sleep(0.2)
    return ""


if __name__ == "__main__":
    verdict = revoked_certificate()
    print(verdict)
    sys.exit(0 if verdict.held else 1)
