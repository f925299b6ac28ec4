"""What an actor decides for itself: its settings, its name, where it runs. Everything else comes from the learner."""

import os
import re
import socket
from dataclasses import dataclass
from typing import Literal

from daedalus.policy.user_modules import NO_MODULES, UserModules
from daedalus.protocol import keys
from daedalus.protocol.messages import Origin
from daedalus.protocol.releases import own_release
from daedalus.protocol.texts import MAX_NAME
from daedalus.transport.interface import Transport

LinkChoice = Literal["auto", "lan", "wan"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ActorConfig:
    """Everything that an actor decides for itself."""

    name: str
    incarnation: int
    run: str = keys.ANY_RUN
    environments: int | None = None  # E; None: as many as the learner's specification says
    runtime: Literal["onnx", "torch"] = "onnx"
    inference: str | None = None  # Unix socket of the process that runs the policy; None: this process does
    modules: UserModules = NO_MODULES  # that may be imported for environments
    link: LinkChoice = "auto"  # wan: fetch compact snapshots; lan: as on a fast link; auto: measure the link and decide
    timeout: float | None = None  # seconds to look for a learner; None: for ever
    searched_since: float | None = None  # monotonic time when the search began; None: once there is a connection
    waits_for_return: bool = False  # whether to look for ever for a learner that has gone, whatever the timeout
    max_policy_age: float | None = None  # seconds within which the learner must confirm the policy; None: no limit
    any_run: bool = False  # whether the actor may change to another run when its learner has gone

    def run_to_join(self, followed: str) -> str:
        """Return the run to look for; `followed` is the run that the actor joined before, or an empty text."""
        return self.run if self.any_run or not followed else followed


def own_name(identity: str = "", number: int = 1) -> str:
    """Return a name that no other actor of the run has: CERTIFICATE.HOST-PID, or HOST-PID without a certificate.

    The host is part of it because processes on several hosts, such as those of containers, have equal numbers.

    Args:
      identity: name in the certificate, or empty.
      number: which actor of this process it is, from 1.
    """
    first, last = f"{identity}." if identity else "", f"-{os.getpid()}" + (f".{number}" if number > 1 else "")
    host = re.sub(r"[^A-Za-z0-9-]", "-", socket.gethostname()).strip("-") or "actor"
    return f"{first}{host[: max(MAX_NAME - len(first) - len(last), 0)]}{last}"


def own_origin(transport: Transport) -> Origin:
    """Return the name of this host, the version of this software and the address of this end of the connection."""
    return Origin(host=socket.gethostname(), software=own_release(), address=transport.local_address)
