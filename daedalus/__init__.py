"""Actor-critic reinforcement learning with one learner and any number of actors, on any machines.

This is the public API. Each name is imported when it is first used, so `import daedalus` loads no other package:

    result = daedalus.train("cartpole")
    evaluation = daedalus.evaluate(result.directory)
    policy = daedalus.load_policy(result.directory)
    action = policy.act(observation)
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from daedalus.actor.client import Client
    from daedalus.actor.environments.environment_errors import EnvironmentSetupError
    from daedalus.actor.evaluation.loaded_policy import Decisions, Policy, load_policy
    from daedalus.actor.evaluation.video import VideoError
    from daedalus.analysis.recorded_run import read_metrics
    from daedalus.launch.callbacks import Callback, TrainingRun
    from daedalus.launch.evaluation import EvaluationResult, evaluate
    from daedalus.launch.match_evaluation import MatchScore, MatchScores
    from daedalus.launch.train_function import RunResult, TrainingError, resume, train
    from daedalus.learner.run.run_files import RunDataError
    from daedalus.learner.run.settings import SettingsError
    from daedalus.policy.saving.hub import HubError
    from daedalus.policy.saving.onnx_graph import ExportError
    from daedalus.policy.saving.saved_policy import NoPolicyError
    from daedalus.policy.saving.sealed import DamagedError

    __version__: str

__all__ = [
    "Callback",
    "Client",
    "DamagedError",
    "Decisions",
    "EnvironmentSetupError",
    "EvaluationResult",
    "ExportError",
    "HubError",
    "MatchScore",
    "MatchScores",
    "NoPolicyError",
    "Policy",
    "RunDataError",
    "RunResult",
    "SettingsError",
    "TrainingError",
    "TrainingRun",
    "VideoError",
    "__version__",
    "evaluate",
    "load_policy",
    "read_metrics",
    "resume",
    "train",
]

_MODULES = {
    "Callback": "daedalus.launch.callbacks",
    "Client": "daedalus.actor.client",
    "Decisions": "daedalus.actor.evaluation.loaded_policy",
    "DamagedError": "daedalus.policy.saving.sealed",
    "EnvironmentSetupError": "daedalus.actor.environments.environment_errors",
    "EvaluationResult": "daedalus.launch.evaluation",
    "ExportError": "daedalus.policy.saving.onnx_graph",
    "HubError": "daedalus.policy.saving.hub",
    "MatchScore": "daedalus.launch.match_evaluation",
    "MatchScores": "daedalus.launch.match_evaluation",
    "NoPolicyError": "daedalus.policy.saving.saved_policy",
    "Policy": "daedalus.actor.evaluation.loaded_policy",
    "RunDataError": "daedalus.analysis.recorded_run",
    "RunResult": "daedalus.launch.train_function",
    "SettingsError": "daedalus.learner.run.settings",
    "TrainingError": "daedalus.launch.train_function",
    "TrainingRun": "daedalus.launch.callbacks",
    "VideoError": "daedalus.actor.evaluation.video",
    "evaluate": "daedalus.launch.evaluation",
    "load_policy": "daedalus.actor.evaluation.loaded_policy",
    "read_metrics": "daedalus.analysis.recorded_run",
    "resume": "daedalus.launch.train_function",
    "train": "daedalus.launch.train_function",
}


def __getattr__(name: str) -> Any:
    """Import a name of the public API when it is first used."""
    import importlib

    if name == "__version__":
        import importlib.metadata

        value: Any = importlib.metadata.version("daedalus-rl")
    elif name in _MODULES:
        value = getattr(importlib.import_module(_MODULES[name]), name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the names of the public API and of the module itself."""
    return sorted({*globals(), *__all__})
