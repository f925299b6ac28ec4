"""One ONNX file of a policy: everything between an observation and an action of the environment, and what it says.

What remains for the caller stands in the file's metadata: to repeat actions, to take the maximum of two frames of an
Atari game, and to leave out components.
"""

import importlib.metadata
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import gymnasium
import numpy as np
import onnxruntime
from gymnasium import spaces as gym

from daedalus.actor.environments.components import Leaf, leaves
from daedalus.actor.environments.info import MASK_KEY
from daedalus.actor.environments.transforms import Transforms
from daedalus.policy.acting.noise import NoiseSize
from daedalus.policy.acting.runtime import action_name, mask_name, observation_name
from daedalus.policy.saving.onnx_graph import NOISE, ExportError, OnnxGraph, Quantization, quantized, uniform_count
from daedalus.policy.saving.saved_policy import SavedPolicy

_MOST_BOUNDS = 1024  # of a component; those of larger ones are left out of the metadata
_MOST_ROWS = 4096


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportOptions:
    """What a user wants of the file."""

    sampled: bool = False  # sampled actions, from random numbers that are an input; else greedy ones
    rows: int | None = None  # observations of each call; None: any number
    quantize: Quantization | None = None  # smaller numbers
    licence: str = ""  # for the metadata

    def __post_init__(self) -> None:
        """Raise ExportError for values that cannot be used."""
        if self.rows is not None and not 1 <= self.rows <= _MOST_ROWS:
            raise ExportError(f"rows is {self.rows}: it must be from 1 to {_MOST_ROWS}, or left out for any number")
        if self.quantize is not None and self.quantize not in get_args(Quantization):
            raise ExportError(f"quantize is {self.quantize!r}: choose from {', '.join(get_args(Quantization))}")


def exported_file(
    saved: SavedPolicy,
    transforms: Transforms,
    space: tuple[gymnasium.Space, gymnasium.Space],
    size: NoiseSize,
    options: ExportOptions,
    caller: dict[str, Any],
) -> bytes:
    """Return the ONNX file of a policy whose program has been checked.

    Args:
      saved: the policy.
      transforms: of its environment.
      space: of the environment's own observations and actions.
      size: of the noise of the program.
      options: what the user wants.
      caller: what is left for the caller to do, for the metadata.

    Raises ExportError if it cannot be made as asked.
    """
    if options.sampled and saved.spec.training.record.heads == "action_values":
        raise ExportError(
            f"the policy of {saved.spec.training.algorithm} takes the best of its action values and has nothing to "
            "sample from: leave out sampled"
        )
    if options.sampled and not any(size):
        raise ExportError("the distribution of this policy takes no random numbers: leave out sampled")
    graph = OnnxGraph(options.rows)
    observations, masks = transforms.add_inputs(graph)
    inputs = {observation_name(name): value for name, value in observations.items()}
    inputs |= {mask_name(name): value for name, value in masks.items()}
    values = graph.include(saved.program, saved.weights, inputs, size, sampled=options.sampled)
    transforms.add_outputs(graph, {name: values[action_name(name)] for name in transforms.spaces.actions})
    states = {
        f"state/{name}": {
            "next": f"next_state/{name}",
            "shape": state.shape,
            "dtype": np.dtype(state.dtype).name,
            "initial": 0,
        }
        for name, state in graph.states.items()
    }
    content = {
        "spaces": {
            "observations": [_described(leaf) for leaf in leaves(space[0], "observation")],
            "actions": [_described(leaf) for leaf in leaves(space[1], "action")],
        },
        "outputs": graph.output_names,
        "masks": {transforms.mask_input(name): count for name, count in transforms.spaces.masks.items()},
        "states": states,
        "noise": {NOISE: uniform_count(size)} if options.sampled else {},
        "caller": caller,
    }
    version = importlib.metadata.version("daedalus-rl")
    spec = saved.spec
    metadata = {
        **{f"daedalus.{name}": json.dumps(value) for name, value in content.items()},
        "daedalus.version": version,
        "daedalus.run": _run_name(saved.directory),
        "daedalus.policy_version": str(saved.policy_version),
        "daedalus.environment": spec.environment.id,
        "daedalus.algorithm": spec.training.algorithm,
        "daedalus.actions": "sampled" if options.sampled else "greedy",
        "daedalus.numbers": options.quantize or "float32",
        "licence": options.licence,
    }
    model = graph.model(version)
    return quantized(model, options.quantize, metadata)


def write_new(path: Path, content: bytes) -> None:
    """Write a file that does not exist yet. Raises ExportError if it exists, or cannot be written."""
    check_new(path)
    try:
        with open(path, "xb") as file:  # fails if somebody else wrote the file meanwhile
            try:
                file.write(content)
            except OSError:
                path.unlink(missing_ok=True)
                raise
    except OSError as error:
        raise ExportError(f"{path} cannot be written: {error.strerror}") from None


def check_new(path: Path) -> None:
    """Raise ExportError if a path exists, or has no folder."""
    if path.exists() or path.is_symlink():
        raise ExportError(f"{path} exists and is left as it is: choose another name, or remove it")
    if not path.parent.is_dir():
        raise ExportError(f"{path.parent} is no folder: create it, or choose another name")


def _run_name(directory: Path) -> str:
    """Return the name of the run of a checkpoint, or of a pretrained policy."""
    folder = directory.absolute()
    return folder.parents[1].name if folder.parent.name == "checkpoints" else folder.name


def _described(leaf: Leaf) -> dict[str, Any]:
    """Return a component of the environment's spaces as JSON."""
    space = leaf.space
    found: dict[str, Any] = {"name": leaf.name, "path": leaf.path, "kind": type(space).__name__}
    if space.shape is not None:
        found |= {"shape": space.shape, "dtype": str(space.dtype)}
    if isinstance(space, gym.Discrete):
        found |= {"n": int(space.n), "start": int(space.start)}
    elif isinstance(space, gym.MultiDiscrete):
        found |= {"nvec": space.nvec.tolist(), "start": space.start.tolist()}
    elif isinstance(space, gym.Box):
        found |= {"low": _bounds(space.low), "high": _bounds(space.high)}
    return found


def _bounds(values: np.ndarray) -> Any:
    """Return bounds as JSON: one number if all are equal, null for none."""
    numbers = values.astype(np.float64).ravel()
    bounds = [float(number) if np.isfinite(number) else None for number in numbers[:_MOST_BOUNDS]]
    if (numbers == numbers[0]).all():
        return bounds[0]
    return bounds if len(bounds) == len(numbers) else "omitted"


def inputs_and_outputs(model: bytes) -> list[str]:
    """Return what an exported file takes, gives and leaves to its caller, in words."""
    session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    caller = json.loads(session.get_modelmeta().custom_metadata_map["daedalus.caller"])
    repeats = f"give each action {caller['repeat_each_action']} times"
    if any(entry.name.partition(".")[0] == MASK_KEY for entry in session.get_inputs()):
        repeats += ", or until a mask forbids it"
    left = [
        *([f"wrap the environment with {caller['wrapper']}"] if caller["wrapper"] else []),
        *([repeats] if caller["repeat_each_action"] > 1 else []),
        *(["show the maximum of the two newest frames"] if caller["maximum_of_two_frames"] else []),
    ]
    sides = {"inputs": session.get_inputs(), "outputs": session.get_outputs()}
    lines = [
        f"{side}: "
        + ", ".join(
            f"{entry.name} {entry.type.removeprefix('tensor(').removesuffix(')')} [{', '.join(map(str, entry.shape))}]"
            for entry in entries
        )
        for side, entries in sides.items()
    ]
    return [*lines, *([f"left to the caller: {'; '.join(left)}"] if left else [])]
