"""The distribution of a whole action: independent distributions of its components."""

import torch
from torch import Tensor, nn

from daedalus.policy.network.distributions import (
    Categorical,
    Distribution,
    Greedy,
    SquashedGaussian,
    continuous_distribution,
    without_illegal,
)
from daedalus.policy.network.layers import Components, find_class
from daedalus.policy.user_code import first_line, place_of
from daedalus.policy.user_modules import NO_MODULES, NetworkError, UserModuleError, UserModules
from daedalus.protocol.spaces import ContinuousSpace, DiscreteSpace, Spaces
from daedalus.protocol.spec import LossSpec, PolicySpec


class ActionDistribution(nn.Module):
    """Independent distributions of the components of an action.

    Log-probability and entropy of an action are the sums over its components. The parameters and the noise of all
    components lie side by side, in the order of the components.
    """

    def __init__(
        self, spec: PolicySpec, spaces: Spaces, modules: UserModules = NO_MODULES, training: LossSpec | None = None
    ) -> None:
        """Raise NetworkError if a distribution does not support its component, or may not be imported.

        `training` names the algorithm, which may learn action values: None stands for one that does not.
        """
        super().__init__()
        self._names, self._masked = tuple(spaces.actions), frozenset(spaces.masks)
        if training is not None and training.record.heads == "action_values":
            distributions: list[Distribution] = [Greedy(_only_choice(spaces, training.algorithm))]
        else:
            if training is not None and training.record.replay:
                _check_replay(spaces, training.algorithm)
            distributions = [_distribution(spec, name, space, modules) for name, space in spaces.actions.items()]
        self.components = nn.ModuleList(distributions)
        self._sizes = [component.parameter_count for component in self._distributions()]
        self.parameter_count = sum(self._sizes)
        self.uniform_count = sum(component.uniform_count for component in self._distributions())
        self.normal_count = sum(component.normal_count for component in self._distributions())

    def sample(self, parameters: Tensor, uniform: Tensor, normal: Tensor, masks: Components) -> Components:
        """Return one sample of each row.

        Args:
          parameters: [N, P].
          uniform: [N, U], from 0 to 1, 1 excluded.
          normal: [N, G], standard normal.
          masks: of the masked components [N, choices] bool.

        Returns: actions of each component [N, D].
        """
        uniforms = uniform.split([component.uniform_count for component in self._distributions()], -1)
        normals = normal.split([component.normal_count for component in self._distributions()], -1)
        parts = zip(self._parts(parameters, masks), uniforms, normals, strict=True)
        return {name: part.sample(own, u, n) for (name, part, own), u, n in parts}

    def sample_and_log_prob(self, parameters: Tensor, normal: Tensor) -> tuple[Tensor, Tensor]:
        """Return reparameterised samples of squashed Gaussians, side by side [B, D], and their log-density [B].

        Args:
          parameters: [B, P].
          normal: [B, D], standard normal.
        """
        noise = normal.split([component.normal_count for component in self._distributions()], -1)
        samples = [
            part.sample_and_log_prob(own, own_noise)
            for (_, part, own), own_noise in zip(self._parts(parameters, {}), noise, strict=True)
            if isinstance(part, SquashedGaussian)
        ]
        return torch.cat([actions for actions, _ in samples], -1), _sum([log_prob for _, log_prob in samples])

    def log_prob(self, parameters: Tensor, actions: Components, masks: Components) -> Tensor:
        """Return log pi(a | s): parameters [..., P], actions [..., D], masks [..., choices] -> [...], in nats."""
        parts = self._parts(parameters, masks)
        return _sum([part.log_prob(own, actions[name]) for name, part, own in parts])

    def log_prob_and_entropy(self, parameters: Tensor, actions: Components, masks: Components) -> tuple[Tensor, Tensor]:
        """Return log pi(a | s) and H(pi(. | s)), both [...], in nats; arguments as for `log_prob`."""
        parts = self._parts(parameters, masks)
        results = [part.log_prob_and_entropy(own, actions[name]) for name, part, own in parts]
        return _sum([log_prob for log_prob, _ in results]), _sum([entropy for _, entropy in results])

    def entropy(self, parameters: Tensor, masks: Components) -> Tensor:
        """Return H(pi(. | s)) [...], in nats; arguments as for `log_prob`."""
        return _sum([part.entropy(own) for _, part, own in self._parts(parameters, masks)])

    def probabilities(self, parameters: Tensor, masks: Components) -> Components:
        """Return the probabilities of all choices [..., D, A] of each discrete action; arguments as for `log_prob`."""
        parts = self._parts(parameters, masks)
        return {name: part.probabilities(own) for name, part, own in parts if isinstance(part, Categorical)}

    def _parts(self, parameters: Tensor, masks: Components) -> list[tuple[str, Distribution, Tensor]]:
        """Return name, distribution and parameters of each component; illegal choices have probability 0."""
        owns = parameters.split(self._sizes, -1) if len(self._sizes) > 1 else (parameters,)
        parts = zip(self._names, self._distributions(), owns, strict=True)
        return [
            (name, part, without_illegal(own, masks[name]) if name in self._masked else own)
            for name, part, own in parts
        ]

    def _distributions(self) -> list[Distribution]:
        return [component for component in self.components if isinstance(component, Distribution)]


def _sum(terms: list[Tensor]) -> Tensor:
    return terms[0] if len(terms) == 1 else torch.stack(terms).sum(0)


def _only_choice(spaces: Spaces, algorithm: str) -> DiscreteSpace:
    """Return the only action, which must be discrete. Raises NetworkError, which names the algorithm, if not."""
    if spaces.only_choice is not None:
        return spaces.only_choice
    only = next(iter(spaces.actions.values()))
    table = ", or name discrete actions with environment.action_table" if isinstance(only, ContinuousSpace) else ""
    raise NetworkError(
        f"training.algorithm={algorithm} learns the value of each choice of one discrete action, but this environment "
        f"has {spaces.listed_actions}: use a2c, a3c, impala or appo{table if len(spaces.actions) == 1 else ''}"
    )


def _check_replay(spaces: Spaces, algorithm: str) -> None:
    """Raise NetworkError, which names the algorithm, unless it can learn the actions."""
    if not spaces.fits_replay:
        raise NetworkError(
            f"training.algorithm={algorithm} needs continuous actions with bounds on both sides, or one discrete "
            f"action without masks, but this environment has {spaces.listed_actions}: use appo, or let a wrapper "
            "(--wrap) change the actions"
        )


def _distribution(
    spec: PolicySpec, name: str, space: DiscreteSpace | ContinuousSpace, modules: UserModules
) -> Distribution:
    """Return the distribution of one component. Raises NetworkError if it does not support the component."""
    if isinstance(space, DiscreteSpace):
        return Categorical(space)
    if ":" in spec.distribution:
        return _custom(spec.distribution, name, space, modules)
    try:
        return continuous_distribution(spec, space)
    except ValueError as error:
        raise NetworkError(
            f"policy.distribution={spec.distribution} {error}, but {name!r} is {space}: "
            "set policy.distribution to gaussian"
        ) from None


def _custom(reference: str, name: str, space: ContinuousSpace, modules: UserModules) -> Distribution:
    """Return the user's distribution `module:Class` for a continuous component."""
    try:
        distribution = find_class("policy.distribution", reference, Distribution, modules)(space)
        counts = (distribution.parameter_count, distribution.uniform_count, distribution.normal_count)
        if not all(isinstance(count, int) and count >= 0 for count in counts) or not counts[0]:
            raise NetworkError(f"has counts {counts}: parameter_count must be at least 1, the others at least 0")
        _try(distribution, space)
    except UserModuleError as error:
        raise NetworkError(str(error)) from error.__cause__
    except NetworkError as error:
        raise NetworkError(f"policy.distribution={reference}, for {name!r}: {error}") from error.__cause__
    except Exception as error:  # the user's code may raise anything
        raise NetworkError(f"policy.distribution={reference}: {first_line(error)}{place_of(error)}") from error
    return distribution


def _try(distribution: Distribution, space: ContinuousSpace) -> None:
    """Call the functions of a user's distribution with two rows. Raises NetworkError, and whatever they raise."""
    parameters = torch.zeros((2, distribution.parameter_count))
    uniform = torch.full((2, distribution.uniform_count), 0.5)
    with torch.no_grad():
        actions = distribution.sample(parameters, uniform, torch.zeros((2, distribution.normal_count)))
        results = {
            "sample": (actions, (2, space.size)),
            "log_prob": (distribution.log_prob(parameters, actions), (2,)),
            "entropy": (distribution.entropy(parameters), (2,)),
        }
    for name, (values, shape) in results.items():
        if not isinstance(values, Tensor) or values.shape != shape:
            found = tuple(values.shape) if isinstance(values, Tensor) else type(values).__name__
            raise NetworkError(f"{name} returns {found} for two rows: it must be a tensor of shape {shape}")
        if not values.isfinite().all():
            raise NetworkError(f"{name} of parameters that are all 0 is not finite: {values.flatten()[0]:g}")
