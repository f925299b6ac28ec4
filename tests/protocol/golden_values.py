"""Contents of the golden messages as JSON beside their bytes, for clients in other languages.

Of each message its kind, its fields and, by name, the dtype, shape and values of its arrays; those row by row in the
order of the shape, whatever order they travel in. `PYTHONPATH=. python tests/protocol/golden_values.py` writes them.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
from golden import FOLDER, MESSAGES

from daedalus.protocol import codec
from daedalus.protocol.codec import FIRST_VERSION

PATH: Path = FOLDER / f"v{FIRST_VERSION}" / "values.json"


def values() -> dict[str, Any]:
    """Return the content of each message by its name."""
    described = {}
    for name, message in MESSAGES.items():
        arrays: list[tuple[str, np.ndarray]] = []
        fields = codec.pack(message, "", arrays)
        described[name] = {
            "kind": type(message).__name__,
            "fields": fields,
            "arrays": {
                array_name: {"dtype": array.dtype.str, "shape": array.shape, "values": array.flatten().tolist()}
                for array_name, array in arrays
            },
        }
    return described


if __name__ == "__main__":
    lines = (f"{json.dumps(name)}: {json.dumps(content)}" for name, content in values().items())
    PATH.write_text("{\n" + ",\n".join(lines) + "\n}\n")
