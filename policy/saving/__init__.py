"""Policies on disk: sealed directories, and the names of checkpoints."""
