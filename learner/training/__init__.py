"""The update: optimisers, precision, checkpoints."""
