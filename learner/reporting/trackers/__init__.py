"""Experiment trackers: Weights & Biases, MLflow and Trackio. They run in processes of their own."""
