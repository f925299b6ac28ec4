"""A torch whose import does not end: see `without_training` in processes.py."""

import threading

threading.Event().wait()
