"""Exporting a policy as a program, and running it to choose actions."""
