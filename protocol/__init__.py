"""The wire protocol: messages, their encoding, the run's specification and key expressions. Pure, without I/O."""
