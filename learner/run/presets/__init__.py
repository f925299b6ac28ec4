"""Tuned settings per environment, one TOML file each."""
