"""Hiding of passwords and tokens in texts that are logged, kept or published: one rule for all of them."""

import os
import re
from functools import lru_cache
from urllib.parse import quote, unquote, urlsplit

HIDDEN = "***"
_SHORTEST = 6  # characters of a value of the process environment: shorter ones are in ordinary words
# No pattern begins with a repetition: a line of 64 KiB without a space must not take seconds.
_WORDS = r"(?:api_?-?key|access_?-?key|private_?-?key|token|passw(?:or)?d|passphrase|pwd|secret|credential)s?(?![a-z])"
_SECRET_NAME = re.compile(_WORDS, re.IGNORECASE)
_OF_URL = re.compile(r"(?<=://)[^\s/?#\"'<>]+@")  # the user's name may be a token
_ASSIGNED = re.compile(
    rf"((?:{_WORDS}[\w.-]{{0,40}}|[?&;](?:key|auth|sig|signature))[\"']?=[\"']?)[^\s\"'&;,<>#]+", re.IGNORECASE
)
_SAID = re.compile(
    r"((?:api[ _-]?key|password|passphrase|secret|(?:access|auth|bearer)[ _-]?token)[\"']?:[ \t]{0,8}[\"']?)"
    r"[^\s\"',;}]+",
    re.IGNORECASE,
)
_HEADER = re.compile(
    r"(\b(?:authorization[\"']?[ \t]{0,8}[:=][ \t]{0,8}[\"']?(?:bearer |basic |token )?|bearer ))[\w.~+/=-]{8,}",
    re.IGNORECASE,
)
_KNOWN = re.compile(r"\b(?:hf_|ghp_|gho_|github_pat_|wandb_v1_|sk-|glpat-)[\w-]{16,}")
_HINTS = re.compile(r"[:=_-]|bearer", re.IGNORECASE)  # without any of them no pattern fits


def without_secrets(text: str) -> str:
    """Return a text with passwords and tokens as `***`.

    Hidden are: user and password of an address, parameters of a query and assignments whose names are those of secrets,
    authorization headers, tokens in known forms, and the values of the process environment under such names, such as
    WANDB_API_KEY, or the password in MLFLOW_TRACKING_URI, wherever they stand.
    """
    for value in _environment_secrets():
        text = text.replace(value, HIDDEN)
    if _HINTS.search(text) is None:
        return text
    text = _OF_URL.sub(f"{HIDDEN}@", text)
    for pattern in (_ASSIGNED, _SAID, _HEADER):
        text = pattern.sub(rf"\g<1>{HIDDEN}", text)
    return _KNOWN.sub(HIDDEN, text)


def is_secret(name: str, value: str) -> bool:
    """Return whether a setting of this name holds a password or a token."""
    return _is_secret_name(name) or without_secrets(value) != value


@lru_cache(1024)  # the names of the process environment are the same for each line that is logged
def _is_secret_name(name: str) -> bool:
    return _SECRET_NAME.search(name) is not None


def _environment_secrets() -> list[str]:
    """Return the secrets of the process environment, the longest first."""
    found: set[str] = set()
    for name in os.environ:
        value = os.environ.get(name, "")  # not of `items`: another thread may remove it meanwhile
        if _is_secret_name(name):
            found.add(value)
        elif "@" in value and "://" in value:
            try:
                password = urlsplit(value).password or ""
            except ValueError:  # no address
                continue
            found |= {password, unquote(password), quote(unquote(password), safe="")}
    # The value of TOKEN_FILE=/run/secrets/token is a path, and that of TOKENIZERS_PARALLELISM a word.
    secrets = (each for each in found if len(each) >= _SHORTEST and not each.startswith(("/", ".")))
    return sorted((each for each in secrets if not each.isalpha()), key=len, reverse=True)
