"""Rollouts from environments and a policy runtime."""
