"""Serving of actors: joins, intake of rollouts, buffers, publication of snapshots, evaluations."""
