"""The network: the transport interface, its in-memory and Zenoh implementations, addresses and TLS."""
