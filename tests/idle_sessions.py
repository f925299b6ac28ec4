"""Program that connects many clients to a router: `python tests/idle_sessions.py tcp/HOST:PORT COUNT`.

It prints `connected` once all are connected, and runs until it is killed.
"""

import sys
import threading

from daedalus.transport.connecting import connect_with_retry

if __name__ == "__main__":
    never = threading.Event()
    sessions = [connect_with_retry([sys.argv[1]], never) for _ in range(int(sys.argv[2]))]
    print("connected", flush=True)
    never.wait()
