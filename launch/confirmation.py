"""Confirmation of a solved run: new sampled episodes with the policy of the moment at which the target was reached.

The mean of the newest training episodes reaches the target more probably in a lucky moment, and while they were played
the policy changed. So their mean is too high on average, and the policy of that moment may be worse than those before.
New episodes with that policy show what it can do. They are played while the learner waits.
"""

import math
import subprocess
from pathlib import Path
from statistics import NormalDist
from typing import Any

from daedalus.launch.child_output import ChildOutput
from daedalus.launch.final_evaluation import EvaluationFailedError, EvaluationProcess, without_episodes
from daedalus.learner.run.confirmation_file import ConfirmationFile
from daedalus.policy.saving.saved_policy import checkpoint_path
from daedalus.protocol.spec import RunSpec

_CONFIDENCE = 0.95  # share of cases that an interval is to contain
_NAME = "confirmation"  # of the process
_SEEDS = 2**34  # added to the seed of the run: no other evaluation of the run and no training uses these seeds


def confirmation_arguments(spec: RunSpec) -> list[str]:
    """Return the options of `daedalus evaluate` that confirm the policy of a run, without the checkpoint."""
    training = spec.training
    options = ["--actions", "sampled", "--backend", spec.environment.backend]
    return [*options, "--episodes", str(training.target_episodes), "--seed", str(training.seed + _SEEDS)]


def confirmation(result: dict[str, Any], target: float) -> dict[str, Any]:
    """Return the result of `daedalus evaluate` with two more entries.

    `interval` is the 95 % interval of the mean (None of one episode). `confirmed`: the mean itself reaches the target.
    So a policy whose true mean is the target is confirmed in half of the attempts, one that is one standard error below
    it in 16 of 100, and two in 2 of 100. The upper end of the interval would accept them in 98, 84 and 49 of 100.
    """
    interval = mean_interval(result["return_mean"], result["return_std"], result["episodes"])
    return {**result, "interval": interval, "confirmed": result["return_mean"] >= target}


def mean_interval(mean: float, std: float, count: int) -> tuple[float, float] | None:
    """Return the 95 % interval of a mean over `count` values, or None for a single value.

        mean +- t s / sqrt(n),  s^2 = n / (n - 1) std^2

    with the 97.5 % quantile t of Student's distribution, n - 1 degrees of freedom.

    Args:
      mean, std: of the values; std is that of the values themselves, with n in the denominator.
    """
    if count < 2:
        return None
    error = _t_quantile(count - 1) * std / math.sqrt(count - 1)
    return mean - error, mean + error


def _t_quantile(freedom: int) -> float:
    """Return the 97.5 % quantile of Student's t, to eight digits.

    Up to 200 degrees of freedom that of the exact distribution, Abramowitz & Stegun (1964), equations 26.7.3 and
    26.7.4; beyond, where its series is exact to ten digits, equation 26.7.5.
    """
    if freedom <= 200:
        low, high = 0.0, math.pi / 2
        while (angle := (low + high) / 2) not in (low, high):
            low, high = (angle, high) if _t_within(angle, freedom) < _CONFIDENCE else (low, angle)
        return math.sqrt(freedom) * math.tan(high)
    z = NormalDist().inv_cdf((1.0 + _CONFIDENCE) / 2)
    terms = (
        z,
        (z**3 + z) / 4,
        (5 * z**5 + 16 * z**3 + 3 * z) / 96,
        (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384,
    )
    return sum(term / freedom**power for power, term in enumerate(terms))


def _t_within(angle: float, freedom: int) -> float:
    """Return the probability that |t| is at most sqrt(freedom) tan(angle)."""
    odd = freedom % 2
    term, total = (math.cos(angle), 0.0) if odd else (1.0, 0.0)
    for power in range(odd, freedom - 1, 2):
        total += term
        term *= math.cos(angle) ** 2 * (power + 1) / (power + 2)
    if odd:
        return 2 / math.pi * (angle + math.sin(angle) * total)
    return math.sin(angle) * total


class Confirmations:
    """Player of the new episodes of one run, for its launcher."""

    def __init__(self, directory: Path, spec: RunSpec, options: list[str], output: ChildOutput) -> None:
        """Construct without starting a process. `options` are further ones of `daedalus evaluate`."""
        self._directory, self._file, self._output = directory, ConfirmationFile(directory), output
        self._file.clear()  # of a launcher that was killed
        self._options = [*confirmation_arguments(spec), *options]
        self._target = spec.training.target_return
        self._playing: EvaluationProcess | None = None
        self._version = -1  # of the policy that plays

    def poll(self) -> None:
        """Start the episodes that the learner asks for, and give it their result, or say that they cannot be played.

        Raises EvaluationFailedError if the result cannot be saved.
        """
        if self._playing is None:
            if (version := self._file.asked()) is not None:
                self._version, checkpoint = version, checkpoint_path(self._directory, version)
                arguments = [str(checkpoint), *self._options]
                self._playing = EvaluationProcess(arguments, _NAME, self._output, shown=True)
        elif self._playing.has_ended():
            result = self._result()
            self.close()
            if self._version == self._file.asked():  # a learner that was restarted asks again
                try:
                    self._file.answer(self._version, result)
                except OSError as error:  # the learner would wait for ever
                    raise EvaluationFailedError(f"the confirmation cannot be saved: {error.strerror}") from None

    def _result(self) -> dict[str, Any]:
        """Return the result for the learner. It has the entry `failed` if the episodes could not be played."""
        assert self._playing is not None
        assert self._target is not None
        try:
            return confirmation(without_episodes(self._playing.result()), self._target)
        except EvaluationFailedError:
            return {"failed": self._output.last_error(_NAME)}

    @property
    def processes(self) -> list[subprocess.Popen[bytes]]:
        """The process that plays, if there is one."""
        return [] if self._playing is None else [self._playing.process]

    def close(self) -> None:
        """End the process that plays."""
        if self._playing is not None:
            self._playing.close()
            self._playing = None
