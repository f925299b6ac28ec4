"""Check of an environment before a run: its API, its spaces, its speed."""
