"""The name of an actor that was given none."""

import os
import re
import socket

from daedalus.protocol.texts import MAX_NAME


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
