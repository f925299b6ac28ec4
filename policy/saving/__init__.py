"""Policies on disk: directories with checksums, and the names of checkpoints."""
