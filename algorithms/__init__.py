"""The mathematics of learning: batches, returns, losses, gradients. Needs torch, but nothing of the learner."""
