"""One run on this machine: its processes, their supervision, and the evaluation of its result."""
