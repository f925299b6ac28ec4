"""`from actor import Client`: an actor for a simulator or robot that owns its clock.

    spaces = {"observation_space": robot.observation_space, "action_space": robot.action_space}
    with Client("tcp/gpu-box:7447", **spaces) as client:
        while robot.works():
            action = client.act(robot.look())
            client.reward(robot.do(action))
            if robot.fell():
                client.end_episode(terminated=True)

It sends the same rollouts as any actor, from a thread of its own: no call waits for the network once the first policy
has come. Where the learner is away, or too slow, the newest rollouts are kept and the policy of last is played.
"""

import os
import re
import secrets
import socket
import threading
from pathlib import Path
from types import TracebackType
from typing import Any

import gymnasium

from daedalus.actor.collecting.client_collector import ClientPlayer
from daedalus.actor.session.learner_queries import ActorError
from daedalus.actor.session.service import ActorConfig, ActorService, LinkChoice
from daedalus.protocol import keys
from daedalus.transport.connecting import connect_with_retry
from daedalus.transport.security import authorization_hint, credentials_to_connect


class Client:
    """One actor, whose loop is the caller's. Not for several threads at once."""

    def __init__(
        self,
        connect: str,
        *,
        observation_space: gymnasium.Space,
        action_space: gymnasium.Space,
        name: str | None = None,
        run: str = keys.ANY_RUN,
        tls: Path | None = None,
        link: LinkChoice = "auto",
        timeout: float = 60.0,
    ) -> None:
        """Joins, and waits for the first policy.

        Args:
          connect: the learner's or router's address, such as `tcp/gpu-box:7447`.
          observation_space, action_space: gymnasium's; a Box, and a Discrete or what the run's action table is over.
          name: the same after a restart; default: from the host's and the process's.
          run: which run to join, where several share a network.
          tls: this actor's certificate (`daedalus certs`), for addresses that begin with tls/.
          link: see `daedalus actor --help`.
          timeout: seconds to wait for a learner and its first policy.

        Raises ActorError, TransportError, EnvironmentSetupError, AddressError or CredentialsError.
        """
        credentials = credentials_to_connect([connect], tls, "actor")
        host = credentials.name if credentials else re.sub(r"[^A-Za-z0-9-]", "-", socket.gethostname()).strip("-")[:40]
        config = ActorConfig(
            name=keys.check_name(name or f"{host}.{os.getpid()}", "actor name"),
            incarnation=secrets.randbits(62),
            run=run,
            link=link,
            timeout=timeout,
            hint=authorization_hint(credentials),
        )
        self._stop = threading.Event()
        self._player = ClientPlayer(observation_space, action_space)
        self._error: Exception | None = None
        transport = connect_with_retry([connect], self._stop, timeout, credentials)
        assert transport is not None  # nobody tells it to stop
        self._transport = transport
        self._service = ActorService(config, transport, self._stop, self._player)
        self._player.on_full = self._service.wake
        self._thread = threading.Thread(target=self._serve, name="actor", daemon=True)
        self._thread.start()
        if not self._player.ready.wait(timeout) or self._error is not None:
            self.close()
            raise self._error or ActorError(f"no policy came within {timeout:g} s: does the learner work?")

    def act(self, observation: Any) -> Any:
        """The action to take now. Once the run is over it is the last policy's, and nobody learns from it.

        Raises ValueError for an observation that is not of the space, ActorError if the learner shut this actor out.
        """
        if self._error is not None:
            raise self._error
        return self._player.act(observation)

    def reward(self, value: float) -> None:
        """Adds to what the last action earned; may be called any number of times. Raises ValueError."""
        self._player.reward(value)

    def end_episode(self, *, terminated: bool, observation: Any = None) -> None:
        """Ends an episode; the next `act` begins another.

        `terminated`: by its own end, after which there is nothing to be had; else it was cut, and `observation`, the
        last one, tells what could have been. Raises ValueError.
        """
        self._player.end_episode(observation, terminated=terminated)

    @property
    def dropped(self) -> int:
        """Rollouts that were given up because the learner took none for long."""
        return self._player.dropped

    @property
    def is_over(self) -> bool:
        """Whether the run has ended: acting goes on, learning does not."""
        return not self._thread.is_alive()

    def close(self) -> None:
        """Leaves the run. Idempotent."""
        self._stop.set()
        self._thread.join(timeout=10.0)
        self._transport.close()

    def _serve(self) -> None:
        try:
            self._service.run()
        except Exception as error:  # told to the caller's thread by its next act()
            self._error = error
        finally:
            self._player.ready.set()

    def __enter__(self) -> "Client":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
