"""A run: its settings, presets, directory and counters."""
