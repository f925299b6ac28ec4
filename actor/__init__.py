"""Plays: environments, the collector, the service that streams rollouts to a learner. No torch by default."""
