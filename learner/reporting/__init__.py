"""Metrics and their writers, status, summary, progress line."""
