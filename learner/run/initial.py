"""The run whose weights a new run begins with."""

from pathlib import Path
from typing import Any

from daedalus.learner.run.run_directory import VERSIONS, read_json
from daedalus.learner.run.settings import SettingsError
from daedalus.policy.saving.saved_policy import NoPolicyError, SavedPolicy, checkpoints, find_policy
from daedalus.policy.saving.sealed import DamagedError
from daedalus.protocol.spaces import ContinuousSpace, DiscreteSpace, Spaces
from daedalus.protocol.spec import EnvironmentSpec, PolicySpec


def check_initial(directory: Path | None, *, other_spaces: bool = False) -> None:
    """Raise SettingsError if no policy can be read from a directory, that of --init-from; None: there is none.

    `other_spaces` is --allow-other-spaces, which needs a directory.
    """
    if other_spaces and directory is None:
        raise SettingsError("--allow-other-spaces is for the weights of another run: add --init-from, or leave it out")
    _check(directory, "--init-from: ")


def allows_other_spaces(directory: Path) -> bool:
    """Return whether a run was started with --allow-other-spaces, as its versions.json says. Raises SettingsError."""
    return (directory / VERSIONS).exists() and read_json(directory / VERSIONS).get("init_from_other_spaces") is True


def initial_to_resume(directory: Path) -> Path | None:
    """Return the run whose weights a resumed run still has to begin with, or None.

    A run that was stopped before its first checkpoint begins with them again; versions.json names their run. Raises
    SettingsError if no policy can be read from there.
    """
    if checkpoints(directory) or not (directory / VERSIONS).exists():
        return None
    recorded = read_json(directory / VERSIONS).get("init_from")
    initial = None if recorded is None else Path(recorded)
    _check(initial, f"the run in {directory} has no checkpoint, and begins with the weights of another run, but ")
    return initial


def _check(initial: Path | None, source: str) -> None:
    if initial is not None:
        try:
            find_policy(initial)
        except (DamagedError, NoPolicyError) as error:
            raise SettingsError(f"{source}{error}") from None


def other_spaces(policy: SavedPolicy, environment: EnvironmentSpec, spaces: Spaces) -> str:
    """Return what differs between the spaces of a policy and those of a run, or an empty string.

    Weights fit wherever the shapes do, but a policy means nothing by numbers of another name, order or scale.
    """
    found = [
        *_components("observation", policy.spaces.observations, spaces.observations),
        *_components("action", policy.spaces.actions, spaces.actions),
    ]
    for name in ("action_table", "action_table_columns"):  # what the choices mean
        if getattr(policy.spec.environment, name) != getattr(environment, name):
            found.append(f"environment.{name} is another")
    return "; ".join(found)


def _components(kind: str, before: dict[str, Any], now: dict[str, Any]) -> list[str]:
    missing, new = (", ".join(sorted(one.keys() - other.keys())) for one, other in ((before, now), (now, before)))
    found = [f"{kind} {missing} is not in this run"] if missing else []
    found += [f"{kind} {new} is not in that run"] if new else []
    for name in before.keys() & now.keys():
        if before[name] != now[name]:
            found.append(f"{kind} {name} is {_in_detail(before[name])} there, and {_in_detail(now[name])} here")
    if not found and list(before) != list(now):
        found.append(f"the components of the {kind} are in the order {', '.join(before)} there, {', '.join(now)} here")
    return found


def _in_detail(space: Any) -> str:
    """Return a space in words, with what differs between spaces of the same words."""
    if isinstance(space, ContinuousSpace) and len(set(zip(space.low, space.high, strict=True))) > 1:
        return f"{space} (low {_some(space.low)}, high {_some(space.high)})"
    if isinstance(space, DiscreteSpace) and space.size > 8:
        return f"{space} ({_some(space.counts)})"
    return str(space)


def _some(values: tuple[float | None, ...]) -> str:
    texts = ["none" if value is None else f"{value:g}" for value in values[:8]]
    return " ".join([*texts, *(["..."] if len(values) > 8 else [])])


def other_network(policy: SavedPolicy, spec: PolicySpec, spaces: Spaces) -> str:
    """Return the first setting by which a run's network computes something else from equal weights, or an empty string.

    Settings that change names or shapes of weights are left to the loading of the weights. Needs torch.
    """
    from daedalus.policy.network.encoders import encoder_names

    before = policy.spec.policy
    names = encoder_names(before, policy.spaces.observations), encoder_names(spec, spaces.observations)
    different = {"encoder": names}
    if "mlp" in names[1] or ":" in names[1]:
        different["activation"] = before.activation, spec.activation
    if any(isinstance(space, ContinuousSpace) for space in spaces.actions.values()):
        different["distribution"] = before.distribution, spec.distribution
    for name, (there, here) in different.items():
        if there != here:
            return f"policy.{name} is {there} there, and {here} here: use the same [policy] settings"
    return ""
