"""The network, in torch. An actor that plays the exported program imports none of these files."""
