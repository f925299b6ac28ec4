"""Ends any process that unpickles a class or a function: with this folder on PYTHONPATH, Python loads it by itself."""

import os
import sys


def _hook(event: str, arguments: tuple) -> None:
    if event == "pickle.find_class":
        os.write(2, f"UNPICKLED {arguments}\n".encode())
        os._exit(97)


sys.addaudithook(_hook)
