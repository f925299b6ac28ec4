"""The command line: the commands of `daedalus`, and the processes that they start."""
