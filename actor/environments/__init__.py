"""Environments: backends, transforms and the mapping of actions."""
