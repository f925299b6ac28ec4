"""Distributions of actions: one class a file, composed by `ActionDistributions`. Needs torch."""
