"""The commands that a person types, and the processes that they start."""
