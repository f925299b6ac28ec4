"""A router on its own, as `zenohd` is: `python tests/router_process.py tcp/HOST:PORT` until it is told to stop."""

import sys

from protocol.process import stop_on_signals
from protocol.zenoh_transport import listen

if __name__ == "__main__":
    stop = stop_on_signals()
    router = listen([sys.argv[1]])
    try:
        print("listening", flush=True)
        while not stop.wait(60.0):
            pass
    finally:
        router.close()
