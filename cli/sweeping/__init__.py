"""A sweep: runs of many settings and seeds on this machine."""
