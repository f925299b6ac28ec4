"""`daedalus COMMAND`: finds the command and runs it. Imports nothing that the command does not need."""

import gc
import os
import sys

from daedalus.cli.command_table import COMMANDS, USAGE
from daedalus.launch.logs import say
from daedalus.launch.process_lifecycle import exit_on_thread_exceptions, exit_status, interrupts_held


def main() -> int:
    """Run the command that the command line names, and return its exit status."""
    return exit_status(_run)


def _run() -> int:
    arguments = sys.argv[1:]
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(USAGE)
        return 0 if arguments else 2
    if arguments[0] == "--version":
        from daedalus import __version__

        print(f"daedalus {__version__}")
        return 0
    command, rest = arguments[0], arguments[1:]
    if command not in COMMANDS:
        import difflib

        near = difflib.get_close_matches(command, COMMANDS, 1, 0.5)
        hint = f"did you mean {near[0]}?" if near else "`daedalus --help` lists the commands"
        say(f"daedalus: unknown command {command!r}: {hint}", sys.stderr)
        return 2
    if COMMANDS[command].function:
        exit_on_thread_exceptions()
        gc.disable()  # what is imported is kept: the collector would look through it again and again
        run = COMMANDS[command].load()
        gc.freeze()
        gc.enable()
        return run(rest)
    line = [sys.executable, "-P", "-m", f"daedalus.cli.commands.{command}", *rest]
    if sys.platform == "win32" or not hasattr(os, "execv"):  # Windows would return to the shell at once
        import subprocess

        return subprocess.run(line, check=False).returncode
    # The command replaces this process, so signals reach it and its exit status is returned.
    with interrupts_held():
        os.execv(sys.executable, line)
