"""Distributions of actions: one kind a file, composed by `ActionDistribution` (joint.py). Needs torch."""
