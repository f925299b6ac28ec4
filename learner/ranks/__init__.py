"""A learner of several processes (ranks): rank 0 leads, the others compute the gradients of their parts with it."""
