"""Actor-critic reinforcement learning with one learner and any number of actors, anywhere."""
