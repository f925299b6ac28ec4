"""Rollouts from environments and a policy, for an actor's service to upload."""
