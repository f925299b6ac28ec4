"""Evaluation: whole episodes, the evaluator, and videos."""
