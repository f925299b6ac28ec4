"""`daedalus certs`: create a private CA, certificates for its processes, and tokens for clients of a gateway."""

import argparse
import datetime
import math
import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from daedalus.cli.arguments import command_parser
from daedalus.launch.certificates import ClientTokens
from daedalus.launch.logs import print_error, say
from daedalus.transport.certificate_expiry import WARNING_DAYS
from daedalus.transport.credentials import CLIENTS, CredentialsError

if TYPE_CHECKING:
    from daedalus.launch.certificates import CertificateFolder, Identity

_DAYS = 825
_LISTENERS, _NAMED = ("learner", "router", "gateway"), ("actor", "operator", "client")

_DESCRIPTION = """\
Creates certificates, so that only authorised actors can join a run, over encrypted connections. The folder ca/ holds
the keys of the certificate authority (CA): keep it secret. Each other folder is one identity: copy it to the host that
uses it, and name it there with --tls."""

_EXAMPLES = f"""\
examples:
  daedalus certs init certs --host gpu-box.lan --host 192.168.1.7
  daedalus certs issue actor arm-1 arm-2
  daedalus learner cartpole --listen tls/0.0.0.0:7447 --tls certs/learner
  daedalus actor --connect tls/gpu-box.lan:7447 --tls certs/actor-arm-1
  daedalus certs list
  daedalus certs renew                    (all that expire within {WARNING_DAYS} days)
  daedalus certs revoke actor arm-1
  daedalus certs issue gateway --host play.example
  daedalus certs issue client phone-1     (a token for a client of the gateway)

One CA is one trust domain: the certificates above are for all runs of a router. To keep its users apart:
  daedalus certs issue learner alice              serves the runs alice and alice.ANYTHING only, over a router
  daedalus certs issue actor arm-3 --run alice    joins, and
  daedalus certs issue operator ann --run alice   reads and orders these runs only

The certificate of an actor allows it to play under its name NAME or NAME.ANYTHING. The certificate of an operator
allows `daedalus status`, `exporter`, `checkpoint`, `stop` and `drain`; its token is for the page of a gateway.
Learners and routers notice within seconds that a file in their folder has changed: after `issue` and `revoke`, copy
{CLIENTS} to their folders if they run elsewhere. Nothing has to be restarted. A renewed certificate is used from the
next connection on. A client of a gateway has a token in place of a certificate, valid for its name NAME and for
NAME.ANYTHING; copy gateway/tokens.json if the gateway runs elsewhere.

exit status: 0 done, 1 failed, 2 bad usage"""


def parser() -> argparse.ArgumentParser:
    """Return the parser of `daedalus certs`."""
    options = command_parser("certs", _DESCRIPTION, _EXAMPLES)
    verbs = options.add_subparsers(dest="verb", required=True, metavar="VERB")
    init = verbs.add_parser("init", help="create a CA, and certificates for the learner, a router and one operator")
    init.add_argument("directory", type=Path, metavar="DIR", help="a new or empty folder")
    _add_host(init)
    issue = verbs.add_parser("issue", help="create certificates or tokens, or new ones in their place")
    issue.add_argument("role", choices=(*_NAMED, *_LISTENERS), help="kind of process that uses the certificate")
    issue.add_argument(
        "names",
        nargs="*",
        metavar="NAME",
        help="name of an actor, operator or client; of a learner, the run that its certificate is only for",
    )
    _add_host(issue)
    issue.add_argument(
        "--run",
        default="",
        metavar="RUN",
        help="the certificates of these actors or operators are only for the runs RUN and RUN.ANYTHING (default: for "
        "all runs; an existing one stays as it is)",
    )
    renew = verbs.add_parser("renew", help="create new certificates and tokens in place of those that expire soon")
    renew.add_argument(
        "role", nargs="?", choices=(*_NAMED, *_LISTENERS), help="kind of process whose certificate is renewed now"
    )
    renew.add_argument("names", nargs="*", metavar="NAME", help="name of an actor, operator or client (default: all)")
    revoke = verbs.add_parser("revoke", help="withdraw the authorisation of actors, operators and clients")
    revoke.add_argument("role", choices=(*_NAMED, "learner"), help="kind of process that used the certificate")
    revoke.add_argument("names", nargs="+", metavar="NAME", help="name of an actor, operator or client")
    listed = verbs.add_parser("list", help="show all certificates and when they expire")
    for verb in (init, issue, renew):
        verb.add_argument(
            "--days",
            type=_days,
            default=_DAYS,
            metavar="N",
            help="days until the certificates expire (default: %(default)s)",
        )
    for verb in (issue, renew, revoke, listed):
        verb.add_argument(
            "--directory",
            type=Path,
            default=Path("certs"),
            metavar="DIR",
            help="folder that init made (default: certs)",
        )
    return options


def _add_host(options: argparse.ArgumentParser) -> None:
    options.add_argument(
        "--host",
        action="append",
        default=[],
        help="name or address that actors use for the learner or router. May be given several times",
    )


def _days(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= 3650:
        raise argparse.ArgumentTypeError(f"{text} is not a number of days from 1 to 3650")
    return int(text)


def certs(arguments: list[str]) -> int:
    """Run `daedalus certs` and return its exit status."""
    parsed = parser().parse_args(arguments)
    try:
        from daedalus.launch.certificates import CertificateFolder

        if parsed.verb == "init":
            lines = _init(parsed)
        else:
            verbs = {"issue": _issue, "renew": _renew, "revoke": _revoke, "list": _list}
            lines = verbs[parsed.verb](CertificateFolder(parsed.directory), parsed)
    except ImportError:
        print_error("certs", 'cryptography is not installed: pip install "daedalus-rl[certs]"')
        return 1
    except (CredentialsError, OSError, ValueError) as error:
        print_error("certs", error)
        return 1
    say("\n".join(lines))
    return 0


def _init(parsed: argparse.Namespace) -> list[str]:
    from daedalus.launch.certificates import CertificateFolder, Identity

    directory = parsed.directory
    folder = CertificateFolder.create(directory, parsed.host, _lifetime(parsed))
    _issue_operators(folder, [Identity("operator", "operator")], parsed.days)
    return [
        f"{directory}/ca          the keys of the CA: keep them secret",
        f"{directory}/learner     for the option --tls of daedalus learner",
        f"{directory}/router      for the option --tls of daedalus router",
        f"{directory}/operator    for the option --tls of daedalus status, exporter, checkpoint, stop and drain",
        f"valid for {', '.join(folder.hosts(Identity('learner')))}; "
        f"next: daedalus certs issue actor NAME --directory {shlex.quote(str(directory))}",
    ]


def _issue(folder: "CertificateFolder", parsed: argparse.Namespace) -> list[str]:
    if parsed.role == "client":
        return _issue_tokens(folder, [identity.name for identity in _named(parsed)], parsed.days)
    identities = _named(parsed)
    folder.issue(identities, _lifetime(parsed), parsed.host)
    _issue_operators(folder, identities, parsed.days)
    return _issued(folder, identities)


def _issue_operators(folder: "CertificateFolder", identities: "list[Identity]", days: int) -> None:
    """Issue the tokens of the operators among the identities, for the page of a gateway.

    An operator of certain runs has none: a gateway cannot tell for which run it is.
    """
    tokens = ClientTokens(folder.directory)
    known = {identity: identity for identity in folder.identities()}
    operators = {each.name: each.folder for each in identities if each.role == "operator" and not known[each].run}
    if operators:
        tokens.issue_operators(operators, days)
    tokens.copy_to_gateway()


def _issue_tokens(folder: "CertificateFolder", names: list[str], days: int) -> list[str]:
    ClientTokens(folder.directory).issue(names, days)
    lines = [f"{folder.directory}/client-{name}/token    give this token to the client" for name in names]
    return [*lines, _copy_tokens(folder)]


def _copy_tokens(folder: "CertificateFolder") -> str:
    return f"a gateway on another host: copy {folder.directory}/gateway/tokens.json to its folder"


def _renew(folder: "CertificateFolder", parsed: argparse.Namespace) -> list[str]:
    if parsed.role is None:
        return _renew_expiring(folder, parsed)
    if parsed.role == "client":
        tokens = ClientTokens(folder.directory).days_left()
        unknown = [name for name in parsed.names if name not in tokens]
        if unknown:
            raise CredentialsError(f"no token was issued for {', '.join(unknown)}: see `daedalus certs list`")
        return _issue_tokens(folder, parsed.names or list(tokens), parsed.days)
    known = folder.identities()
    if parsed.role in _NAMED and not parsed.names:
        identities = [identity for identity in known if identity.role == parsed.role]
    else:
        identities = _named(parsed)
        unknown = [identity.folder for identity in identities if identity not in known]
        if unknown:
            raise CredentialsError(f"no certificate was issued for {', '.join(unknown)}: see `daedalus certs list`")
    return _renew_certificates(folder, identities, parsed)


def _renew_expiring(folder: "CertificateFolder", parsed: argparse.Namespace) -> list[str]:
    identities = [identity for identity, issued in folder.identities().items() if issued.days_left < WARNING_DAYS]
    tokens = ClientTokens(folder.directory).days_left()
    names = [name for name, days in tokens.items() if days < WARNING_DAYS]
    lines = _renew_certificates(folder, identities, parsed) if identities else []
    lines += _issue_tokens(folder, names, parsed.days) if names else []
    return lines or [f"no certificate {'or token ' if tokens else ''}expires within {WARNING_DAYS} days"]


def _renew_certificates(
    folder: "CertificateFolder", identities: "list[Identity]", parsed: argparse.Namespace
) -> list[str]:
    folder.issue(identities, _lifetime(parsed))
    _issue_operators(folder, identities, parsed.days)
    return _issued(folder, identities)


def _revoke(folder: "CertificateFolder", parsed: argparse.Namespace) -> list[str]:
    if parsed.role == "client":
        ClientTokens(folder.directory).revoke(parsed.names)
        return [_copy_tokens(folder)]
    folder.revoke(_named(parsed))
    if parsed.role == "operator":
        ClientTokens(folder.directory).revoke_operators(parsed.names)
    return [_copy_clients(folder)]


def _list(folder: "CertificateFolder", parsed: argparse.Namespace) -> list[str]:
    lines = [f"{'certificate':<24} {'expires':<10} {'days':>5}"]
    for identity, issued in sorted(folder.identities().items(), key=lambda each: each[1].expires):
        days = issued.days_left
        lines.append(f"{identity.folder:<24} {issued.expires:%Y-%m-%d} {math.floor(days):>5}{_state(days)}")
    for name, days in sorted(ClientTokens(folder.directory).days_left().items(), key=lambda each: each[1]):
        lines.append(f"{'client-' + name:<24} {'token':<10} {math.floor(days):>5}{_state(days)}")
    return lines


def _state(days: float) -> str:
    return "  EXPIRED" if days < 0 else "  renew it soon" if days < WARNING_DAYS else ""


def _named(parsed: argparse.Namespace) -> "list[Identity]":
    from daedalus.launch.certificates import Identity

    run = vars(parsed).get("run", "")
    if parsed.role != "learner" and (parsed.role in _NAMED) != bool(parsed.names):
        raise CredentialsError("wrong number of names: name actors, operators, clients and learners, and nobody else")
    if run and parsed.role not in ("actor", "operator"):
        raise CredentialsError(
            "--run is for actors and operators; a learner has its run as its name: issue learner RUN"
        )
    return [Identity(parsed.role, name, run) for name in parsed.names or [""]]


def _issued(folder: "CertificateFolder", identities: "list[Identity]") -> list[str]:
    lines = []
    for identity in identities:
        path = folder.directory / identity.folder
        if not identity.listens:
            lines.append(f"{path}    copy this folder to the host of the {identity.role}, for its option --tls")
        else:
            lines.append(f"{path}    valid for {', '.join(folder.hosts(identity))}")
    return [*lines, _copy_clients(folder)]


def _copy_clients(folder: "CertificateFolder") -> str:
    return (
        f"learners and routers on other hosts: copy {folder.directory}/learner/{CLIENTS} to their folders; they read "
        "it within seconds"
    )


def _lifetime(parsed: argparse.Namespace) -> datetime.timedelta:
    return datetime.timedelta(days=parsed.days)
