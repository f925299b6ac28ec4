"""The process of `daedalus gateway`: read its certificates and tokens, listen, and serve.

Exit status: 0 stopped by a signal, 1 failed, 2 bad usage.
"""

import asyncio
import errno
import logging
import os
import socket
import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from daedalus.actor.environments.minari_files import DatasetError, new_dataset_folder
from daedalus.actor.errors import ActorError
from daedalus.gateway.security import OperatorToken
from daedalus.gateway.watching.page_data import FolderView, OtherRun
from daedalus.launch.logs import print_error, say
from daedalus.launch.process_lifecycle import BAD_USAGE
from daedalus.learner.reporting.metrics_rows import read_rows
from daedalus.learner.reporting.thinning import MetricsHistory
from daedalus.learner.run.run_directory import CONFIG, METRICS, OUTPUT, REPORT, SUMMARY, read_config, run_name
from daedalus.learner.run.run_files import RunDataError, read_end, read_json
from daedalus.learner.run.settings import SettingsError, changed_settings, flat_settings, setting_text
from daedalus.policy.acting.runtime import PolicyError
from daedalus.policy.user_modules import allow_settings, allow_words
from daedalus.protocol import keys
from daedalus.protocol.texts import printable, short_number
from daedalus.transport.addresses import AddressError, check_listening
from daedalus.transport.credentials import (
    SECURITY_ERRORS,
    Credentials,
    NotValidNowError,
    credentials_to_connect,
    load,
    run_for,
)
from daedalus.transport.interface import TransportError
from daedalus.transport.retries import Retries

_logger = logging.getLogger(__name__)

LISTEN = "127.0.0.1:8080"
GATEWAY_PACKAGES = ("starlette", "uvicorn", "websockets")
INSTALL = 'the gateway needs starlette, uvicorn and websockets: pip install "daedalus-rl[gateway]"'
MAX_RUNS = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class GatewayOptions:
    """What a gateway process was started with."""

    connect: list[str]  # addresses of the learner or of its router
    run: str = keys.ANY_RUN
    listen: str = LISTEN
    or_any_port: bool = False
    hosts: list[str]  # further names under which clients reach the gateway
    origins: list[str]  # web sites whose pages may connect
    tls: Path | None = None  # folders of certificates: of an actor, of the web server, of an operator
    serve_tls: Path | None = None
    operator: Path | None = None
    operator_token: Path | None = None  # file
    insecure: bool = False
    compare: list[Path]  # run directories whose curves the page shows
    camera: bool = True
    run_directory: Path | None = None  # of the run, for what the page shows of it
    allowed_modules: Sequence[str] = ()
    takes_clients: bool = True
    record: str = ""  # the dataset of the clients' episodes
    for_a_person: bool = False  # print the address of the page for the person who started the run


class OtherRuns:
    """Readers of run directories that the user named on the command line. One thread at a time."""

    def __init__(self, directories: list[Path]) -> None:
        """Raise ValueError or OSError if a directory is none of a run, or if there are too many."""
        if len(directories) > MAX_RUNS:
            raise ValueError(f"{len(directories)} runs are given with --compare: at most {MAX_RUNS} can be shown")
        self._known: dict[Path, tuple[int, OtherRun]] = {}  # with the time of the file
        self._directories = directories
        for directory in directories:
            self._read(directory)

    def __call__(self) -> list[OtherRun]:
        """Return the runs. One whose file cannot be read is as it was."""
        for directory in self._directories:
            try:
                self._read(directory)
            except (OSError, ValueError) as error:
                _logger.warning("the run to compare with cannot be read: %s", error)
        return [self._known[directory][1] for directory in self._directories]

    def _read(self, directory: Path) -> None:
        path = directory / METRICS
        if not path.exists():
            raise ValueError(f"{directory} has no {METRICS}: it is no run directory, or its run has not begun to train")
        changed = path.stat().st_mtime_ns
        if directory in self._known and self._known[directory][0] == changed:
            return
        history = MetricsHistory()
        for row in read_rows(path):
            history.add(row)
        self._known[directory] = changed, OtherRun(name=directory.resolve().name, rows=history.rows())


@dataclass(frozen=True, slots=True, kw_only=True)
class _Chosen:
    """What the files that the command line names contain."""

    credentials: Credentials | None
    operator: Credentials | None
    serving: Credentials | None
    operator_token: OperatorToken | None
    other_runs: OtherRuns

    @classmethod
    def of(cls, options: GatewayOptions) -> "_Chosen":
        """Read the files. Raises SECURITY_ERRORS, OSError or ValueError."""
        if options.operator is not None and options.tls is None:
            raise ValueError("--operator is for networks with certificates: use --tls too, or leave it out")
        if options.operator_token is not None and options.serve_tls is not None:
            raise ValueError("--operator-token is for gateways without --serve-tls: operators have tokens of their own")
        token = None if options.operator_token is None else OperatorToken(options.operator_token)
        return cls(
            credentials=credentials_to_connect(options.connect, options.tls, "actor"),
            operator=None if options.operator is None else load(options.operator, "operator"),
            serving=None if options.serve_tls is None else load(options.serve_tls, "gateway"),
            operator_token=token,
            other_runs=OtherRuns(options.compare),
        )


def run_gateway(options: GatewayOptions, stop: threading.Event) -> int:
    """Run a gateway until `stop` is set, report why it fails, and return the exit status."""
    retries = Retries(stop)
    while True:
        try:
            if options.run != keys.ANY_RUN:
                keys.check_name(options.run, "run")
            if options.record:
                new_dataset_folder(options.record)
            chosen = _Chosen.of(options)
            options = replace(options, run=run_for(chosen.operator, run_for(chosen.credentials, options.run)))
            host, port = _listening_address(options.listen, chosen.serving is not None, options.insecure)
            break
        except NotValidNowError as error:
            if retries.wait(str(error)):
                return 0
        except (ValueError, OSError, DatasetError, *SECURITY_ERRORS) as error:
            print_error("gateway", error)
            return BAD_USAGE
    if chosen.serving is not None:
        chosen.serving.watch_expiry()
    try:
        listener = _listen(host, port, options.or_any_port)
    except OSError as error:
        reason = (error.strerror or str(error)).partition(" (while attempting")[0]  # of socket.create_server
        text = f"cannot listen on {options.listen}: {reason}: choose another --listen"
        print_error("gateway", text)
        return 1
    try:
        asyncio.run(_serve(options, chosen, listener, stop))
        return 0
    except (ActorError, PolicyError, TransportError, OSError, ValueError) as error:
        print_error("gateway", error)
        return 1
    except ImportError:
        print_error("gateway", INSTALL)
        return 1
    finally:
        listener.close()


def _playing(options: GatewayOptions, module: str, *words: str) -> tuple[str, ...] | None:
    """Return the command of a process that plays for the page, or None if none shall."""
    if not options.camera:
        return None
    return (sys.executable, "-P", "-m", f"daedalus.launch.{module}", *allow_words(options.allowed_modules), *words)


def _announce(token_file: Path | None) -> Callable[[str], None]:
    """Return a function that prints the address of the page, for the person who started the run.

    It does not print the token: the output may go to a log that others can read.
    """
    token = "" if token_file is None else f" with the token in {os.path.relpath(token_file)}"
    return lambda address: say(f"watch the run at {address}{token}")


async def _serve(options: GatewayOptions, chosen: "_Chosen", listener: socket.socket, stop: threading.Event) -> None:
    # Imported here, because its packages are an extra.
    from daedalus.gateway.gateway_service import GatewayService, GatewaySettings

    values = [] if options.run_directory is None else ["--checkpoints", str(options.run_directory)]
    settings = GatewaySettings(
        connect=options.connect,
        shown_host=options.listen.rpartition(":")[0],
        run=options.run,
        credentials=chosen.credentials,
        operator=chosen.operator,
        serving=chosen.serving,
        hosts=options.hosts,
        origins=options.origins,
        operator_token=chosen.operator_token,
        other_runs=chosen.other_runs,
        read_folder=(lambda run: None) if options.run_directory is None else WatchedFolder(options.run_directory),
        camera=_playing(options, "camera_process", *values),
        match=_playing(options, "match_process"),
        takes_clients=options.takes_clients,
        record=options.record,
        announce=_announce(options.operator_token) if options.for_a_person else None,
    )
    await GatewayService(settings, stop).run(listener)


def _listen(host: str, port: int, or_any: bool) -> socket.socket:
    """Return a listening socket, at another port if the port is taken and any will do. Raises OSError."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family)
    except OSError as error:
        if not or_any or error.errno != errno.EADDRINUSE:
            raise
        return socket.create_server((host, 0), family=family)


def _listening_address(listen: str, tls: bool, insecure: bool) -> tuple[str, int]:
    """Return host and port. Raises AddressError if others could connect without TLS."""
    host, colon, port = listen.rpartition(":")
    if not colon or not host or not port.isdecimal() or int(port) > 65535:
        raise AddressError(f"{listen!r} is not an address: write HOST:PORT, such as {LISTEN}")
    checked = f"{'tls' if tls else 'tcp'}/{host}:{port if int(port) else 1}"  # with 0 the gateway names the one it got
    try:
        check_listening([checked], tls=tls, insecure=insecure)
    except AddressError:
        raise AddressError(
            f"{listen} is unencrypted and open to every host that can reach it: use --serve-tls (daedalus certs issue "
            f"gateway), listen on {LISTEN}, or add --insecure on a network that you trust"
        ) from None
    return host.strip("[]"), int(port)


_OUTPUT_BYTES = 32 << 10


class WatchedFolder:
    """Reader of one run directory, which may be written meanwhile. One thread at a time.

    What cannot be read is left as it was: the page of a run does not depend on its directory.
    """

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._summary_before = self._stamp(SUMMARY)  # of a life of the learner before this one
        self._read: dict[str, tuple[tuple[int, int], Any]] = {}  # by file: when it was changed, and its content
        self._modules: dict[str, str] = {}

    def __call__(self, run: str) -> FolderView | None:
        """Return what the directory has; None if it is of another run than the one with this name."""
        if run != run_name(self._directory):
            return None
        settings = self._unless_equal(CONFIG, self._settings, ())
        output = self._unless_equal(OUTPUT, lambda: printable(read_end(self._directory / OUTPUT, _OUTPUT_BYTES)), "")
        if self._stamp(SUMMARY) == self._summary_before:
            return FolderView(settings=settings, output=output)
        summary = self._unless_equal(SUMMARY, lambda: read_json(self._directory / SUMMARY) or {}, {})
        ends, stopped = self._ends(summary), summary.get("finished") is False
        return FolderView(settings=settings, output=output, ends=ends, stopped=stopped)

    def _settings(self) -> tuple[tuple[str, str, bool], ...]:
        spec = read_config(self._directory)
        self._modules = spec.user_modules
        values = flat_settings(spec.model_dump(mode="json"))
        changed = set(changed_settings(values))
        return tuple(
            (path, printable(setting_text(value)), path in changed)
            for path, value in values.items()
            if value is not None or path in changed
        )

    def _ends(self, summary: dict[str, Any]) -> tuple[str, ...]:
        """Return how the run ended, beyond what the learner says: its evaluation, its report, how to continue."""
        match summary.get("evaluation"):
            case {"return_mean": float(mean), "return_std": float(std), "episodes": int(episodes), "actions": str(how)}:
                played = f"{episodes:,} {how} episodes"
                evaluated = [f"Evaluation: return {short_number(mean)} ± {short_number(std)} over {played}."]
            case _:
                evaluated = []
        report = self._directory / REPORT
        newest = self._stamp(REPORT)[0] >= self._stamp(SUMMARY)[0] > 0  # else of an earlier end of the run
        words = ["daedalus", "resume", str(self._directory), *allow_settings(self._modules)]
        left = [f"Report, on the host of the gateway: {report}"] if newest else []
        how = [] if summary.get("finished") else [f"Continue it with: {' '.join(words)}"]
        return tuple(map(printable, [*evaluated, *left, *how]))

    def _stamp(self, name: str) -> tuple[int, int]:
        """Return when a file was changed, and its size; zeros without the file."""
        try:
            state = os.stat(self._directory / name)
        except OSError:
            return 0, 0
        return state.st_mtime_ns, state.st_size

    def _unless_equal(self, name: str, read: Callable[[], Any], otherwise: Any) -> Any:
        """Return what `read` makes of a file, read again only if the file has changed."""
        stamp, (before, content) = self._stamp(name), self._read.get(name, ((-1, -1), otherwise))
        if stamp == before:
            return content
        try:
            content = read() if stamp != (0, 0) else otherwise
        except (RunDataError, SettingsError, OSError) as error:
            _logger.debug("%s cannot be shown: %s", name, error)
        self._read[name] = stamp, content
        return content
