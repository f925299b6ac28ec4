"""What crosses the wire, and nothing else: messages, their bytes, the run's specification, keys, transports."""
