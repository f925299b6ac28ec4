"""launch/supervisor.py: the processes of `daedalus train`."""

import os

import pytest

from launch.supervisor import SupervisedActor, stop


@pytest.mark.skipif(not hasattr(os, "setpriority"), reason="processes have no priorities here")
def test_actors_come_after_the_learner() -> None:
    actor = SupervisedActor("actor-0", "tcp/127.0.0.1:1")  # nobody listens there: it goes on looking
    try:
        ours = os.getpriority(os.PRIO_PROCESS, 0)
        assert os.getpriority(os.PRIO_PROCESS, actor.process.pid) == min(ours + 5, 19)
    finally:
        stop([actor.process])
