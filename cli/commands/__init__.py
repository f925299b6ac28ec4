"""One module per command of `daedalus`."""

import gc
import sys

if sys.argv[:1] == ["-m"]:  # `python -m daedalus.cli.commands.actor` has not begun yet
    gc.disable()  # what it imports is kept: the collector would look through it again and again. See exit_status
