"""Status of a running learner, asked by the process of the test: `daedalus status` takes a second to start."""

from daedalus.protocol.codec import ProtocolError
from daedalus.transport.interface import TransportError
from daedalus.transport.status_query import ask
from daedalus.transport.zenoh_transport import connect


def learner_status(address: str) -> dict:
    """Return what `daedalus status --json` prints, or an empty dict if no learner answers at the address."""
    try:
        transport = connect([address])
    except TransportError:
        return {}
    try:
        statuses = ask(transport)
    except (TransportError, ProtocolError):
        return {}
    finally:
        transport.close()
    return statuses[0].model_dump(mode="json") if statuses else {}


def actor_status(status: dict, name: str) -> dict:
    """Return the status of one actor, or an empty dict if the learner does not know it."""
    return next((actor for actor in status.get("actors", ()) if actor["actor"] == name), {})


def env_steps(status: dict, name: str) -> int:
    """Return the env_steps of one actor that the learner has trained on."""
    return actor_status(status, name).get("env_steps", 0)
