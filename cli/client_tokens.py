"""The tokens of a gateway's clients, and of operators, in the folder of `daedalus certs`.

ca/tokens.json         what is kept of each token: its digest and when it expires
gateway/tokens.json    a copy for the gateway, which reads it again when it changes
client-NAME/           token, and ca.pem of the gateways, for the client
operator-NAME/         token, beside the operator's certificate
"""

import json
import shutil
import time
from pathlib import Path

from daedalus.gateway.security import OPERATOR, TOKENS, digest, new_token
from daedalus.policy.saving.regular_files import replace_text
from daedalus.protocol import keys
from daedalus.transport.credentials import CA, CredentialsError

_DAY = 86_400.0


class ClientTokens:
    """The tokens of one network."""

    def __init__(self, directory: Path) -> None:
        """`directory` is a folder that `daedalus certs init` made."""
        self.directory = directory
        self._record = directory / "ca" / TOKENS

    def days_left(self) -> dict[str, float]:
        """Return the days until each client's token expires, by name."""
        now = time.time()
        clients = {name: entry for name, entry in self._read().items() if not name.startswith(OPERATOR)}
        return {name: (entry["expires"] - now) / _DAY for name, entry in clients.items()}

    def issue(self, names: list[str], days: int) -> None:
        """Issue tokens, new or in place of those before. Raises ValueError or CredentialsError for a wrong name."""
        for name in names:
            keys.check_name(name, "client name")
            if "." in name:
                raise CredentialsError(f"{name!r} has a '.': a token for NAME is valid for NAME.ANYTHING too")
        for name in names:
            folder = self.directory / f"client-{name}"
            folder.mkdir(exist_ok=True)
            shutil.copyfile(self.directory / "ca" / "gateway" / CA, folder / CA)
        self._issue({name: f"client-{name}" for name in names}, days)

    def issue_operators(self, folders: dict[str, str], days: int) -> None:
        """Issue tokens of operators, into the folders of their certificates, by name."""
        self._issue({OPERATOR + name: folder for name, folder in folders.items()}, days)

    def revoke_operators(self, names: list[str]) -> None:
        """Withdraw the tokens of operators whose certificates are revoked."""
        known = self._read()
        for name in names:
            known.pop(OPERATOR + name, None)
        self._write(known)

    def _issue(self, folders: dict[str, str], days: int) -> None:
        """Write new tokens into folders, by the name that is kept."""
        known = self._read()
        for name, folder in folders.items():
            token = new_token()
            known[name] = {"sha256": digest(token), "expires": time.time() + days * _DAY}
            replace_text(self.directory / folder / "token", token + "\n", private=True)
        self._write(known)

    def revoke(self, names: list[str]) -> None:
        """Withdraw tokens. Raises CredentialsError if one is not known."""
        known = self._read()
        unknown = [name for name in names if name not in known]
        if unknown:
            raise CredentialsError(f"no client is named {', '.join(unknown)}: see `daedalus certs list`")
        for name in names:
            del known[name]
            shutil.rmtree(self.directory / f"client-{name}", ignore_errors=True)
        self._write(known)

    def copy_to_gateway(self) -> None:
        """Write the gateway's copy, if the folder has a gateway."""
        if (self.directory / "gateway").exists():
            replace_text(self.directory / "gateway" / TOKENS, json.dumps(self._read(), indent=2) + "\n", private=True)

    def _read(self) -> dict[str, dict]:
        return json.loads(self._record.read_text("utf-8")) if self._record.exists() else {}

    def _write(self, known: dict[str, dict]) -> None:
        replace_text(self._record, json.dumps(known, indent=2) + "\n", private=True)
        self.copy_to_gateway()
