"""What both sides need of a network: the interface, the in-memory one, Zenoh, addresses and TLS."""
