"""Studies of the algorithms: one command for each, with raw results as CSV."""
