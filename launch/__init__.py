"""Start and supervise processes: train, evaluate, check an environment, and the standing services."""
