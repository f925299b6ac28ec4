"""The update: learner, optimisers, metrics of updates, checkpoints."""
