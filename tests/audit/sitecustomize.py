"""Audit hook that ends a process that unpickles a class or function. Python loads this file from PYTHONPATH."""

import os
import sys


def _hook(event: str, arguments: tuple) -> None:
    if event == "pickle.find_class":
        os.write(2, f"UNPICKLED {arguments}\n".encode())
        os._exit(97)


sys.addaudithook(_hook)
