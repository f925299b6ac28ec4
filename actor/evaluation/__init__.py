"""Whole episodes played for a score, and videos of them."""
