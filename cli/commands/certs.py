"""`daedalus certs`: create a private CA, and certificates for routers, learners, actors and operators."""

import argparse
import datetime
import json
import os
import shutil
import socket
import sys
from pathlib import Path

from daedalus.cli.arguments import command_parser
from daedalus.protocol import keys
from daedalus.transport.access_control import common_name
from daedalus.transport.credentials import NAMES, Credentials, CredentialsError, read_names
from daedalus.transport.zenoh_settings import Capacity, as_config_file, session_settings

_CA_DAYS, _DAYS = 3650, 825
_LISTENERS = ("learner", "router")
_NAMED = ("actor", "operator")
_ZENOHD = "zenoh.json5"
_RESTART = "restart learners and routers with their updated folders, so that they read the new list of names"

_DESCRIPTION = """\
Creates certificates, so that only authorised actors can join a run, over encrypted connections. The folder ca/ holds
the key of the certificate authority (CA): keep it secret. Each other folder is one identity: copy it to the host that
uses it, and name it there with --tls."""

_EXAMPLES = """\
examples:
  daedalus certs init certs --host gpu-box.lan --host 192.168.1.7
  daedalus certs issue actor arm-1 arm-2 --directory certs
  daedalus learner cartpole --listen tls/0.0.0.0:7447 --tls certs/learner
  daedalus actor --connect tls/gpu-box.lan:7447 --tls certs/actor-arm-1
  daedalus certs revoke actor arm-1 --directory certs

The certificate of an actor allows it to play under its name NAME or NAME.ANYTHING. The certificate of an operator
allows `daedalus status` and `daedalus exporter`. Learners and routers read the list of authorised names when they
start: after `issue` and `revoke`, restart them with the updated folders.

exit status: 0 done, 1 failed, 2 bad usage"""


def parser() -> argparse.ArgumentParser:
    """Return the parser of `daedalus certs`."""
    options = command_parser("certs", _DESCRIPTION, _EXAMPLES)
    host = "name or address that actors use for the learner or router. May be given several times"
    verbs = options.add_subparsers(dest="verb", required=True, metavar="VERB")
    init = verbs.add_parser("init", help="create a CA, and certificates for the learner, a router and one operator")
    init.add_argument("directory", type=Path, metavar="DIR", help="a new or empty folder")
    init.add_argument("--host", action="append", default=[], help=host)
    issue = verbs.add_parser(
        "issue", help="create certificates for actors and operators, or renew that of the learner or router"
    )
    issue.add_argument("role", choices=(*_NAMED, *_LISTENERS), help="kind of process that uses the certificate")
    issue.add_argument("names", nargs="*", metavar="NAME", help="name of an actor or operator")
    issue.add_argument("--host", action="append", default=[], help=host)
    revoke = verbs.add_parser("revoke", help="remove names from the list of authorised names")
    revoke.add_argument("role", choices=_NAMED, help="kind of process that used the certificate")
    revoke.add_argument("names", nargs="+", metavar="NAME", help="name of an actor or operator")
    for verb in (issue, revoke):
        verb.add_argument(
            "--directory",
            type=Path,
            default=Path("certs"),
            metavar="DIR",
            help="folder that init made (default: certs)",
        )
    return options


def certs(arguments: list[str]) -> int:
    """Run `daedalus certs` and return its exit status."""
    parsed = parser().parse_args(arguments)
    try:
        if parsed.verb == "init":
            lines = _init(parsed.directory, parsed.host)
        elif parsed.verb == "issue":
            lines = _issue(parsed.directory, parsed.role, parsed.names, parsed.host)
        else:
            lines = _revoke(parsed.directory, parsed.role, parsed.names)
    except ImportError:
        print('daedalus certs: cryptography is not installed: pip install "daedalus-rl[certs]"', file=sys.stderr)
        return 1
    except (CredentialsError, OSError, ValueError) as error:
        print(f"daedalus certs: {error}", file=sys.stderr)
        return 1
    print("\n".join(lines))
    return 0


def _init(directory: Path, hosts: list[str]) -> list[str]:
    if directory.exists() and any(directory.iterdir()):
        raise CredentialsError(
            f"{directory} is not empty: add certificates with `daedalus certs issue`, or name a new folder"
        )
    from daedalus.cli.certificate_authority import CertificateAuthority

    CertificateAuthority.create(directory / "ca", datetime.timedelta(days=_CA_DAYS))
    for role in _LISTENERS:
        _make(directory, role, "", hosts)
    _make(directory, "operator", "operator", [])
    _write_names(directory, {"actors": [], "operators": ["operator"]})
    return [
        f"{directory}/ca          the key of the CA, which signs all certificates: keep it secret",
        f"{directory}/learner     for the option --tls of daedalus learner",
        f"{directory}/router      for the option --tls of daedalus router",
        f"{directory}/operator    for the option --tls of daedalus status and exporter",
        f"valid for {', '.join(_hosts(hosts))}; next: daedalus certs issue actor NAME --directory {directory}",
    ]


def _issue(directory: Path, role: str, names: list[str], hosts: list[str]) -> list[str]:
    if (role in _NAMED) != bool(names):
        raise CredentialsError("wrong number of names: name actors and operators, but not a learner or router")
    for name in names:
        keys.check_name(name, f"{role} name")
        if "." in name:
            raise CredentialsError(
                f"{name!r} has a '.': name it {name.split('.')[0]!r}, which may also act as {name!r}"
            )
    for name in names or [""]:
        _make(directory, role, name, hosts)
    if role not in _NAMED:
        authorised = _read_authorised(directory)
        _write_names(directory, authorised)
        return [f"{directory / role}    valid for {', '.join(_hosts(hosts))}"]
    authorised = _read_authorised(directory)
    authorised[f"{role}s"] = sorted({*authorised[f"{role}s"], *names})
    _write_names(directory, authorised)
    return [
        *(
            f"{directory / _folder(role, name)}    copy this folder to the host of the {role} and use "
            f"--tls {_folder(role, name)}"
            for name in names
        ),
        _RESTART,
    ]


def _revoke(directory: Path, role: str, names: list[str]) -> list[str]:
    authorised = _read_authorised(directory)
    unknown = set(names) - set(authorised[f"{role}s"])
    if unknown:
        raise CredentialsError(
            f"no {role} is named {', '.join(sorted(unknown))}: see names.json in {directory / 'learner'}"
        )
    authorised[f"{role}s"] = sorted(set(authorised[f"{role}s"]) - set(names))
    _write_names(directory, authorised)
    for name in names:
        shutil.rmtree(directory / _folder(role, name), ignore_errors=True)
    return [_RESTART]


def _folder(role: str, name: str) -> str:
    return role if role in _LISTENERS or name == role else f"{role}-{name}"


def _hosts(hosts: list[str]) -> list[str]:
    """Return the host names of a listener's certificate: the given ones, and those of this machine."""
    return list(dict.fromkeys([*hosts, socket.gethostname(), "localhost", "127.0.0.1", "::1"]))


def _read_authorised(directory: Path) -> dict[str, list[str]]:
    return read_names(directory / "learner")


def _write_names(directory: Path, names: dict[str, list[str]]) -> None:
    """Write the authorised names for learner and router, and the configuration of a standard zenohd."""
    for role in _LISTENERS:
        _replace(directory / role / NAMES, json.dumps(names, indent=2) + "\n")
    folder = (directory / "router").resolve()
    security = Credentials(folder, "router", "").settings(listens=True)
    zenohd = as_config_file(session_settings("router", ["tls/0.0.0.0:7447"], [], security, Capacity()))
    _replace(folder / _ZENOHD, json.dumps(zenohd, indent=2) + "\n")


def _replace(path: Path, text: str) -> None:
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    partial.write_text(text, "utf-8")
    os.replace(partial, path)


def _make(directory: Path, role: str, name: str, hosts: list[str]) -> None:
    from daedalus.cli.certificate_authority import CertificateAuthority

    authority = CertificateAuthority(directory / "ca")
    names = _hosts(hosts) if role in _LISTENERS else []
    authority.issue(directory / _folder(role, name), common_name(role, name), names, datetime.timedelta(days=_DAYS))
