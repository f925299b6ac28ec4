"""The record of an algorithm of the user's own, which a process that starts a run reads from the class."""

from daedalus.learner.run.settings import SettingsError, run_spec
from daedalus.policy.user_modules import UserModules
from daedalus.protocol.spec import RunSpec


def with_record(spec: RunSpec, modules: UserModules) -> RunSpec:
    """Return the specification with the record of its algorithm, if that is the user's own.

    `modules` may be imported. Raises SettingsError.
    """
    if not spec.training.user_modules:
        return spec
    from daedalus.algorithms.own_algorithm import own_class  # torch, which other runs do not need here
    from daedalus.protocol.algorithms import AlgorithmError

    settings = spec.model_dump()
    try:
        settings["training"]["algorithm_record"] = own_class(spec.training.algorithm, modules).record.model_dump()
    except AlgorithmError as error:
        raise SettingsError(str(error)) from None
    return run_spec(settings)
