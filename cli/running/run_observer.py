"""What may look at the training of a run from the process that started it."""

import subprocess


class RunObserver:
    """Observer of the training of a run. This one does nothing."""

    @property
    def descriptors(self) -> tuple[int, ...]:
        """File descriptors that the learner inherits."""
        return ()

    @property
    def learner_options(self) -> list[str]:
        """Options of the learner."""
        return []

    def begin(self, address: str) -> None:
        """Called before the processes start. `address` is where the learner will answer."""

    def end(self) -> None:
        """Called after they have ended, in any way."""

    def poll(self, learner: subprocess.Popen[bytes]) -> bool:
        """Do what is due, and return whether training has to end. Called many times a second."""
        return False
