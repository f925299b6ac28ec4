"""Actors in any language over WebSockets, and the page of a run. Only the command line imports this package."""
