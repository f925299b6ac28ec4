"""Connects clients in other languages to the network over TCP. Only the command line imports this package."""
