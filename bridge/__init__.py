"""Carries a client in another language onto the network. Imports protocol; nothing imports it."""
