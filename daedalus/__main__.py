"""`python -m daedalus` is `daedalus`, for installations whose scripts are not on the path of the shell."""

import sys

if not sys.flags.safe_path:
    del sys.path[0]  # the working directory, whose files, such as random.py, would come before the standard library's

from daedalus.cli.main import main

if __name__ == "__main__":
    raise SystemExit(main())
