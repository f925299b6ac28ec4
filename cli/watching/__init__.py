"""Live display of runs on a terminal."""
