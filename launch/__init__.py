"""The commands that a person types. Starts the others as processes."""
