"""Why an actor cannot take part in a run, or not any more."""


class ActorError(Exception):
    """The actor cannot take part; the message says why and what to do."""


class LearnerLostError(Exception):
    """The learner left, or another learner epoch began; join again."""

    def __init__(self, reason: str = "the learner went away; looking for it again") -> None:
        super().__init__(reason)


class NoLearnerError(ActorError):
    """No learner answered within the time that the user set."""


class ActorRefusedError(ActorError):
    """The learner refused or quarantined the actor."""


class NameInUseError(ActorRefusedError):
    """The actor name is in use by another actor, or was in use a moment ago."""
