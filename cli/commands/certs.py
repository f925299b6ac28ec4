"""`daedalus certs`: a private CA, and certificates for routers, learners, actors and operators."""

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
from daedalus.transport.zenoh_settings import as_config_file, session_settings

_CA_DAYS, _DAYS = 3650, 825
_LISTENERS = ("learner", "router")
_NAMED = ("actor", "operator")
_ZENOHD = "zenoh.json5"

_DESCRIPTION = """\
Makes the certificates with which actors on other hosts take part in a run that strangers cannot join. The folder's
ca/ stays where you keep secrets; each other folder in it is one identity: copy it to where it is used, and name it
with --tls there."""

_EXAMPLES = """\
examples:
  daedalus certs init certs --host gpu-box.lan --host 192.168.1.7
  daedalus certs issue actor arm-1 arm-2 --directory certs
  daedalus learner cartpole --listen tls/0.0.0.0:7447 --tls certs/learner
  daedalus actor --connect tls/gpu-box.lan:7447 --tls certs/actor-arm-1
  daedalus certs revoke actor arm-1 --directory certs

An actor's certificate lets it play under its own name, or NAME.anything, and nothing else; an operator's lets it ask
for the status. Learners and routers read whom they let in when they start: restart them after issue and revoke."""


def parser() -> argparse.ArgumentParser:
    """Return the parser of `daedalus certs`."""
    options = command_parser("certs", _DESCRIPTION, _EXAMPLES)
    verbs = options.add_subparsers(dest="verb", required=True, metavar="VERB")
    init = verbs.add_parser("init", help="a new CA, and certificates for the learner, a router and one operator")
    init.add_argument("directory", type=Path, metavar="DIR")
    init.add_argument("--host", action="append", default=[], help="a name or address that actors reach it by")
    issue = verbs.add_parser("issue", help="certificates for actors and operators, or a learner's or router's anew")
    issue.add_argument("role", choices=(*_NAMED, *_LISTENERS))
    issue.add_argument("names", nargs="*", metavar="NAME")
    issue.add_argument("--host", action="append", default=[], help="for a learner or router, as with init")
    revoke = verbs.add_parser("revoke", help="let a name in no more")
    revoke.add_argument("role", choices=_NAMED)
    revoke.add_argument("names", nargs="+", metavar="NAME")
    for verb in (issue, revoke):
        verb.add_argument("--directory", type=Path, default=Path("certs"), metavar="DIR", help="default: certs")
    return options


def certs(arguments: list[str]) -> int:
    """Runs `daedalus certs`."""
    parsed = parser().parse_args(arguments)
    try:
        if parsed.verb == "init":
            said = _init(parsed.directory, parsed.host)
        elif parsed.verb == "issue":
            said = _issue(parsed.directory, parsed.role, parsed.names, parsed.host)
        else:
            said = _revoke(parsed.directory, parsed.role, parsed.names)
    except ImportError:
        print('daedalus certs: needs cryptography: pip install "daedalus-rl[certs]"', file=sys.stderr)
        return 1
    except (CredentialsError, OSError, ValueError) as error:
        print(f"daedalus certs: {error}", file=sys.stderr)
        return 1
    print("\n".join(said))
    return 0


def _init(directory: Path, hosts: list[str]) -> list[str]:
    if directory.exists() and any(directory.iterdir()):
        raise CredentialsError(f"{directory} is not empty: `daedalus certs issue` adds to it")
    from daedalus.cli.certificate_authority import CertificateAuthority

    CertificateAuthority.create(directory / "ca", datetime.timedelta(days=_CA_DAYS))
    for role in _LISTENERS:
        _make(directory, role, "", hosts)
    _make(directory, "operator", "operator", [])
    _write_names(directory, {"actors": [], "operators": ["operator"]})
    return [
        f"{directory}/ca          the CA's key: keep it here, it makes the others",
        f"{directory}/learner     --tls for the learner (or {directory}/router for a router of its own)",
        f"{directory}/operator    --tls for daedalus status",
        f"reached as {', '.join(_hosts(hosts))}; next: daedalus certs issue actor NAME --directory {directory}",
    ]


def _issue(directory: Path, role: str, names: list[str], hosts: list[str]) -> list[str]:
    if (role in _NAMED) != bool(names):
        raise CredentialsError("actors and operators are issued by name, a learner's or router's certificate without")
    for name in names:
        keys.check_name(name, f"{role} name")
        if "." in name:
            raise CredentialsError(f"{name!r}: no '.' in a certificate's name, it may act as {name.split('.')[0]}.more")
    for name in names or [""]:
        _make(directory, role, name, hosts)
    if role not in _NAMED:
        known = _read_known(directory)
        _write_names(directory, known)
        return [f"{directory / role}    reached as {', '.join(_hosts(hosts))}"]
    known = _read_known(directory)
    known[f"{role}s"] = sorted({*known[f"{role}s"], *names})
    _write_names(directory, known)
    return [
        *(f"{directory / f'{role}-{name}'}    copy it to where it is used: --tls {role}-{name}" for name in names),
        "restart learners and routers with their folders of now, for them to let it in",
    ]


def _revoke(directory: Path, role: str, names: list[str]) -> list[str]:
    known = _read_known(directory)
    unknown = set(names) - set(known[f"{role}s"])
    if unknown:
        raise CredentialsError(f"no {role} is named {', '.join(sorted(unknown))}")
    known[f"{role}s"] = sorted(set(known[f"{role}s"]) - set(names))
    _write_names(directory, known)
    for name in names:
        shutil.rmtree(directory / _folder(role, name), ignore_errors=True)
    return ["restart learners and routers with their folders of now, for them to shut it out"]


def _folder(role: str, name: str) -> str:
    return role if role in _LISTENERS or name == role else f"{role}-{name}"


def _hosts(hosts: list[str]) -> list[str]:
    """The names that a listener's certificate is for: those that were given, and this machine's own."""
    return list(dict.fromkeys([*hosts, socket.gethostname(), "localhost", "127.0.0.1", "::1"]))


def _read_known(directory: Path) -> dict[str, list[str]]:
    return read_names(directory / "learner")


def _write_names(directory: Path, names: dict[str, list[str]]) -> None:
    """Tells the listeners whom they let in, and a stock zenohd in its own words."""
    for role in _LISTENERS:
        _replace(directory / role / NAMES, json.dumps(names, indent=2) + "\n")
    folder = (directory / "router").resolve()
    security = Credentials(folder, "router", "").settings(listens=True)
    zenohd = as_config_file(session_settings("router", ["tls/0.0.0.0:7447"], [], security))
    _replace(folder / _ZENOHD, json.dumps(zenohd, indent=2) + "\n")


def _replace(path: Path, text: str) -> None:
    beside = path.with_name(f".{path.name}.{os.getpid()}.partial")
    beside.write_text(text, "utf-8")
    os.replace(beside, path)


def _make(directory: Path, role: str, name: str, hosts: list[str]) -> None:
    from daedalus.cli.certificate_authority import CertificateAuthority

    authority = CertificateAuthority(directory / "ca")
    names = _hosts(hosts) if role in _LISTENERS else []
    authority.issue(directory / _folder(role, name), common_name(role, name), names, datetime.timedelta(days=_DAYS))
