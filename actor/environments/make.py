"""Creates environments from their specification."""

import logging

from daedalus.actor.environments.environment_errors import EnvironmentSetupError, MissingPackageError
from daedalus.actor.environments.environment_packages import absent, how_to_bring, other_version
from daedalus.actor.environments.transforms import TransformedEnvironment
from daedalus.actor.environments.vector_environments import BackendEnvironments, VectorEnvironment
from daedalus.actor.environments.wrappers import Camera
from daedalus.policy.user_modules import NO_MODULES, UserModuleError, UserModules
from daedalus.protocol.spec import EnvironmentSpec

_logger = logging.getLogger(__name__)


def make_environments(
    spec: EnvironmentSpec,
    count: int,
    *,
    modules: UserModules = NO_MODULES,
    render_mode: str | None = None,
    camera: Camera | None = None,
    one_episode: bool = False,
) -> VectorEnvironment:
    """Return `count` environments of one kind, created by the backend that the specification names.

    Args:
      spec: the environment and its transforms.
      count: E, the number of environments.
      modules: the modules that may be imported for it.
      render_mode: gymnasium's; "human" opens a window, and a camera needs "rgb_array".
      camera: called with the rendered image [H, W, 3] uint8, and the rate at which images are meant to be shown, after
        each reset and after every step, repeated ones included. Requires count 1.
      one_episode: for evaluations: environment e of `reset(seed)` plays an episode that its seed, `seed` + e,
        determines, however many environments there are. It need not play another. Environments that share one random
        generator, because gymnasium registers them with a vector entry point only, are reduced to one environment.

    Only the gymnasium backend supports a wrapper, and only that and games support `render_mode` and `camera`.

    Raises EnvironmentSetupError; its message is one line.
    """
    try:
        modules.check(spec.user_modules)
    except UserModuleError as error:
        raise EnvironmentSetupError(f"{error}{absent(spec)}") from None
    if camera is not None and (count != 1 or render_mode != "rgb_array"):
        raise ValueError(f"a camera needs one environment in render_mode 'rgb_array', not {count} in {render_mode!r}")
    if spec.backend != "gymnasium" and not spec.is_game:
        asked = {"wrap": spec.wrap, "render_mode": render_mode, "camera": camera}
        asked["environment.parameters"] = spec.parameters or None if spec.backend != "fast" else None
        _refuse_gymnasium_options(spec, asked)
    if warning := other_version(spec):
        _logger.warning("%s", warning)
    try:
        bare, rest = make_bare(spec, count, modules, render_mode, camera, one_episode)
    except MissingPackageError as error:
        raise EnvironmentSetupError(f"{error}{how_to_bring(spec)}") from error
    try:
        return TransformedEnvironment(bare, rest, one_episode=one_episode)
    except EnvironmentSetupError:
        bare.close()
        raise


def make_bare(
    spec: EnvironmentSpec,
    count: int,
    modules: UserModules,
    render_mode: str | None = None,
    camera: Camera | None = None,
    one_episode: bool = False,
) -> tuple[BackendEnvironments, EnvironmentSpec]:
    """Return the backend's environments, and the specification without the transforms that the backend does itself.

    See make_environments, which checks the modules and the options. Raises EnvironmentSetupError.
    """
    match spec.backend:
        case "envpool":
            # A backend is imported when it is used.
            from daedalus.actor.environments.envpool_backend import make_envpool

            return make_envpool(spec, count)
        case "pettingzoo":
            from daedalus.actor.environments.games import make_games

            games = make_games(spec, count, modules, render_mode=render_mode)
            if camera is not None:
                games.film(camera)
            return games, spec
        case "ale":
            from daedalus.actor.environments.atari import make_ale

            return make_ale(spec, count)
        case "gymnasium" | "fast":
            from daedalus.actor.environments.gymnasium_backend import make_gymnasium

            environments = make_gymnasium(
                spec, count, modules=modules, render_mode=render_mode, camera=camera, one_episode=one_episode
            )
            return environments, spec


def _refuse_gymnasium_options(spec: EnvironmentSpec, asked: dict[str, object]) -> None:
    names = [name for name, value in asked.items() if value is not None]
    if names:
        raise EnvironmentSetupError(
            f"environment.backend={spec.backend} does not support {' and '.join(names)}: "
            "leave it out, or use --set environment.backend=gymnasium"
        )
