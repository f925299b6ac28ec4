"""One module per command of `daedalus`."""

import gc
import sys

# A process of its own, `python -m daedalus.cli.commands.COMMAND`, begins. What it imports is kept, so the garbage
# collector would look through all of it in vain, which takes a twelfth of the time. `exit_status` enables it again.
if sys.argv[:1] == ["-m"] and any(word.startswith(f"{__name__}.") for word in sys.orig_argv):
    gc.disable()
