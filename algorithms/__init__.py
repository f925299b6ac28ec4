"""The mathematics of learning: batches, returns, losses. Pure functions of tensors; an actor may import them too."""
