"""Size of a specification in a message: a learner sends all of it to every actor that joins. Pure functions."""

from collections.abc import Mapping
from typing import Any

import msgpack

from daedalus.protocol.limits import LEARNER_LIMITS

_MAX_BYTES = LEARNER_LIMITS.max_header_bytes - (8 << 10)  # the rest of a Welcome, and the names of the settings


def check_size(sections: Mapping[str, Mapping[str, Any]]) -> None:
    """Raise ValueError, which names a setting, if no message can hold the specification.

    `sections` has the values of the settings, as plain data.
    """
    sizes: dict[str, int] = {}
    for section, settings in sections.items():
        for name, value in settings.items():
            try:
                sizes[f"{section}.{name}"] = len(msgpack.packb(value) or b"")
            except (ValueError, OverflowError) as error:  # such as an integer of more than 64 bits
                raise ValueError(f"{section}.{name} cannot be sent to actors: {error}") from None
    total = sum(sizes.values())
    if total > _MAX_BYTES:
        largest = max(sizes, key=lambda name: sizes[name])
        raise ValueError(
            f"{largest} has {sizes[largest]:,} bytes, too many to send to actors: all settings together may have "
            f"{_MAX_BYTES:,}, and have {total:,}"
        )
