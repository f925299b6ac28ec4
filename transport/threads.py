"""Exceptions in functions of ours that a library's threads call: treated like those in threads of ours."""

import threading
from collections.abc import Callable
from typing import Any, ParamSpec

Parameters = ParamSpec("Parameters")


def report_exceptions(function: Callable[Parameters, Any]) -> Callable[Parameters, None]:
    """Return `function` with every exception passed to `threading.excepthook`, and without a return value.

    A library that calls a callback on a thread of its own may swallow what the callback raises. An exception there is
    a fault of ours, just as in a `threading.Thread`; the commands install a hook that ends the process.
    """

    def call(*args: Parameters.args, **kwargs: Parameters.kwargs) -> None:
        try:
            function(*args, **kwargs)
        except BaseException as error:  # as threading.Thread does
            details = type(error), error, error.__traceback__, threading.current_thread()
            threading.excepthook(threading.ExceptHookArgs(details))

    return call
