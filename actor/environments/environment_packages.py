"""The Python package that has an environment: which one it is, and what to do on a host that lacks it.

Nothing is imported or installed here. Of the setting `environment.package`, which a peer may have sent, the form is
checked (protocol/spec.py), so that it can stand in a command.
"""

import importlib.metadata
import importlib.util
from pathlib import Path

from daedalus.protocol.spec import EnvironmentSpec, is_requirement

# Packages that register environments with gymnasium when they are imported: beginning of the id -> module and extra.
REGISTERING = {"ALE/": ("ale_py", "atari"), "MiniGrid-": ("minigrid", "minigrid"), "BabyAI-": ("minigrid", "minigrid")}
_OF_BACKENDS = {"envpool": "envpool", "ale": "ale_py"}


def with_package(spec: EnvironmentSpec) -> EnvironmentSpec:
    """Return the specification with the installed package that has the environment, unless one is named."""
    package = spec.package or _installed(_module(spec))
    return spec if package is None else spec.model_copy(update={"package": package})


def _module(spec: EnvironmentSpec) -> str:
    """Return the top-level module that has the environment; empty if it is part of gymnasium, or of this program."""
    if spec.is_from_python:
        return ""
    if spec.backend in _OF_BACKENDS:
        return _OF_BACKENDS[spec.backend]
    if ":" in spec.id or spec.is_game:
        return spec.id.partition(":")[0].partition(".")[0]
    return next((module for beginning, (module, _) in REGISTERING.items() if spec.id.startswith(beginning)), "")


def _installed(module: str) -> str | None:
    """Return `name==version` of the package that has a module, if it has the module's name and no other file hides it.

    A package that is installed from its source folder is left out: no other host can get this version.
    """
    if not module or (origin := _origin(module)) is None:
        return None
    try:
        package = importlib.metadata.distribution(module)
    except (importlib.metadata.PackageNotFoundError, ValueError):
        return None
    requirement = f"{package.metadata['Name']}=={package.version}"
    is_its = origin.is_relative_to(Path(str(package.locate_file(""))).resolve())
    return requirement if is_its and is_requirement(requirement) else None


def _origin(module: str) -> Path | None:
    """Return the file of a top-level module, or None if it is not here; the module is not imported."""
    try:
        found = importlib.util.find_spec(module)
    except (ImportError, ValueError):
        return None
    if found is None or found.origin is None:
        return None
    return Path(found.origin).resolve()


def other_version(spec: EnvironmentSpec) -> str:
    """Return how the installed package differs from that of the run, or an empty text."""
    name, _, wanted = (spec.package or "").partition("==")
    try:
        installed = importlib.metadata.version(name.partition("[")[0]) if name else wanted
    except importlib.metadata.PackageNotFoundError:
        return ""
    if installed == wanted:
        return ""
    return (
        f"the run has environment.package={spec.package}, and version {installed} is installed here: it may be another "
        f"environment; {_install(spec)}"
    )


def how_to_bring(spec: EnvironmentSpec) -> str:
    """Return how to install the package of an environment, as the end of a message; empty if none is named."""
    return "" if spec.package is None else f"; {_install(spec)}"


def absent(spec: EnvironmentSpec) -> str:
    """Return which modules of the user are missing here, and what to do, as the end of a message."""
    tops = {value.partition(":")[0].partition(".")[0] for value in spec.user_modules.values()}
    missing = [
        top for top in sorted(tops) if _origin(top) is None and not (Path(top).exists() or Path(f"{top}.py").exists())
    ]
    if not missing:
        return ""
    folder = "" if spec.package else f": install it, or start in the folder of {missing[0]}.py"
    return f"; {' and '.join(missing)} is not installed here{folder}{how_to_bring(spec)}"


def _install(spec: EnvironmentSpec) -> str:
    return f'if you trust the run, install its package: pip install "{spec.package}"'
