"""One module per command of `daedalus`."""
