"""Metrics, their writers, the status, the progress line."""
