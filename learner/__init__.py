"""Learns: returns and losses, the optimiser and its state, and the service that feeds them. Never imports the actor."""
