"""Processes that log a run to experiment trackers."""
