"""Environments: backends, transforms, action mapping."""
