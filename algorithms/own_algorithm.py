"""An algorithm supplied by the user as `module:Class`: its class, its construction, and a trial before the run."""

from collections.abc import Callable, Iterator
from typing import Any

import torch

from daedalus.algorithms import action_values, policy_gradient, sac
from daedalus.algorithms.algorithm import Algorithm
from daedalus.algorithms.batch import Batch, BatchAssembler
from daedalus.policy.network.action_distribution import ActionDistribution
from daedalus.policy.network.layers import map_components
from daedalus.policy.user_code import first_line, place_of
from daedalus.policy.user_modules import UserModuleError, UserModules
from daedalus.protocol.algorithms import ALGORITHMS, AlgorithmError, AlgorithmRecord, is_own
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import LossSpec

_SETTING = "training.algorithm"
_ROWS, _ENVIRONMENTS = 3, 2  # of the trial


def own_class(name: str, modules: UserModules) -> type[Algorithm]:
    """Return the class `module:Class`.

    Raises AlgorithmError if it may not be imported, or is not a class of Algorithm with a record.
    """
    try:
        found = modules.attribute(_SETTING, name)
    except UserModuleError as error:
        raise AlgorithmError(str(error)) from error.__cause__
    except Exception as error:  # the user's module may raise anything
        raise _fault(name, error) from error
    if not (isinstance(found, type) and issubclass(found, Algorithm)):
        raise AlgorithmError(f"{_SETTING}={name}: it is not a class of daedalus.algorithms.algorithm.Algorithm")
    if not isinstance(found.record, AlgorithmRecord):
        raise AlgorithmError(f"{_SETTING}={name}: its record is not an AlgorithmRecord")
    return found


def own_algorithm(spec: LossSpec, distribution: ActionDistribution, modules: UserModules) -> Algorithm:
    """Return the user's algorithm that `spec.algorithm` names. Raises AlgorithmError."""
    kind: Any = own_class(spec.algorithm, modules)
    try:
        return kind(spec, distribution, **spec.algorithm_kwargs)
    except Exception as error:  # the user's code may raise anything
        raise _fault(spec.algorithm, error) from error


def check_updates(
    spec: LossSpec,
    updates: Callable[[Batch], Iterator[object]],
    after_update: Callable[[], None],
    spaces: Spaces,
    state_size: int,
) -> None:
    """Make the updates of a small batch of zeros, to find the faults of an algorithm before the run.

    Args:
      spec: names the algorithm.
      updates: computes the gradients of a batch; the parameters stay as they are.
      after_update: does what follows an update, and undoes it.
      spaces: components of the batch.
      state_size: S, the size of the policy's memory; 0 without one.

    Raises AlgorithmError.
    """
    device = torch.device("cpu")
    batch = BatchAssembler(spaces, device).allocate(_ROWS, _ENVIRONMENTS, state_size).to(device)
    map_components(batch.masks, lambda mask: mask.fill_(True))
    batch.valid.fill_(1.0)
    expected = spec.updates_from(_ENVIRONMENTS if state_size else _ROWS * _ENVIRONMENTS)
    try:
        with torch.random.fork_rng(devices=()):  # the run itself begins with the random state of its seed
            made = sum(1 for _ in updates(batch))
            after_update()
    except Exception as error:  # the user's code may raise anything
        raise _fault(spec.algorithm, error) from error
    if made > expected:  # fewer where it stops its passes early: the zeros are far from the policy
        raise AlgorithmError(
            f"{_SETTING}={spec.algorithm}: its losses make {made} updates of a batch, and its record says {expected}"
        )


def _fault(name: str, error: Exception) -> AlgorithmError:
    return AlgorithmError(f"{_SETTING}={name}: {first_line(error)}{place_of(error)}")


def _built_in() -> Iterator[tuple[str, type[Algorithm]]]:
    """Yield the classes of the built-in algorithms, each by the name of its record."""
    names = {id(record): name for name, record in ALGORITHMS.items()}
    for module in (policy_gradient, action_values, sac):
        for kind in vars(module).values():
            if isinstance(kind, type) and (name := names.get(id(vars(kind).get("record")))):
                yield name, kind


CLASSES = dict(_built_in())


def build_algorithm(spec: LossSpec, distribution: ActionDistribution, modules: UserModules) -> Algorithm:
    """Return the algorithm named by `spec.algorithm`, for a policy with these action distributions.

    `modules` may be imported. Raises AlgorithmError for an algorithm of the user's own that cannot be constructed.
    """
    if is_own(spec.algorithm):
        return own_algorithm(spec, distribution, modules)
    return CLASSES[spec.algorithm](spec, distribution)
