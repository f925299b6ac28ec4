"""Program that prints the status of a learner repeatedly: `python tests/status_lines.py tcp/HOST:PORT`.

Each line is one JSON object, or empty if no learner answers. The program runs until it is killed.
"""

import sys
import threading

from daedalus.transport.connecting import connect_with_retry
from daedalus.transport.interface import TransportError
from daedalus.transport.status_query import ask

if __name__ == "__main__":
    never = threading.Event()
    transport = connect_with_retry([sys.argv[1]], never)
    assert transport is not None
    while not never.wait(0.2):
        try:
            statuses = ask(transport)
        except TransportError:
            statuses = []
        print(*(status.model_dump_json() for status in statuses), flush=True)
