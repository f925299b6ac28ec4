"""actor/session/actor_config.py: names of actors that were given none."""

import os
import socket

import pytest

from daedalus.actor.session.actor_config import own_name
from daedalus.protocol import keys


@pytest.mark.parametrize("host", ["box", "gpu_box.lan", "h" * 200, "", "-", "größe"])
@pytest.mark.parametrize("identity", ["", "arm-3", "c" * 48])
@pytest.mark.parametrize("number", [1, 2, 4096])
def test_name_is_legal_and_for_the_certificate(
    monkeypatch: pytest.MonkeyPatch, host: str, identity: str, number: int
) -> None:
    monkeypatch.setattr(socket, "gethostname", lambda: host)
    monkeypatch.setattr(os, "getpid", lambda: 4194304)
    name = own_name(identity, number)
    assert keys.is_name(name)
    if identity:
        assert keys.owner(name) == identity


def test_processes_of_equal_number_on_two_hosts_have_different_names(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first process of every container has number 1."""
    monkeypatch.setattr(os, "getpid", lambda: 1)
    names = []
    for host in ("node-1", "node-2"):
        monkeypatch.setattr(socket, "gethostname", lambda host=host: host)
        names += [own_name("fleet"), own_name(), own_name("fleet", 2)]
    assert names[:3] == ["fleet.node-1-1", "node-1-1", "fleet.node-1-1.2"]
    assert len(set(names)) == 6
