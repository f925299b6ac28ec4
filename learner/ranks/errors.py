"""Errors of a learner of several processes. Without torch, so that a command can import them early."""


class RankLostError(Exception):
    """Error of a rank that has died, cannot be reached, or does not answer in time."""


class RanksDisagreeError(Exception):
    """Error of ranks that were not started for the same run. The message says what to do."""
