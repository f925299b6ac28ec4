"""Learner whose run is over when it receives SIGUSR1: `python -m benchmarks.chaos.finishing_learner ARGUMENTS`."""

import signal
import sys
from typing import Any

from daedalus.cli.commands.learner import main
from daedalus.learner.service import LearnerService

if __name__ == "__main__":
    services: list[LearnerService] = []
    construct = LearnerService.__init__

    def noted(self: LearnerService, *arguments: Any, **named: Any) -> None:
        construct(self, *arguments, **named)
        services.append(self)

    def use_up_budget(_number: int, _frame: object) -> None:
        for service in services:
            service._context.counters.env_steps = service._context.spec.training.env_steps

    LearnerService.__init__ = noted  # type: ignore[method-assign] - only in this process
    signal.signal(signal.SIGUSR1, use_up_budget)
    sys.exit(main())
