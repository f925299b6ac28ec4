"""The network in torch. An actor that runs the exported program imports none of these files."""
