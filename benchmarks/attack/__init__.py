"""Attacks on running processes. Each is a program of its own and a function that returns a Verdict."""
