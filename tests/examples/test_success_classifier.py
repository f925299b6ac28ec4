"""The classifier of examples/success_classifier.py, with episodes of the arm and without a network."""

import importlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

EXAMPLES = Path(__file__).parents[2] / "examples"


def episodes(arm: Any, act: Any, seeds: range) -> list[np.ndarray]:
    found = []
    for seed in seeds:
        observation, _ = arm.reset(seed=seed)
        seen, over = [observation], False
        while not over:
            observation, _, terminated, truncated, _ = arm.step(act(observation))
            seen.append(observation)
            over = terminated or truncated
        found.append(np.stack(seen))
    return found


def test_success_is_told_from_what_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(EXAMPLES))
    robot, example = (importlib.import_module(name) for name in ("robot", "success_classifier"))
    torch.set_num_threads(1)
    torch.manual_seed(1)
    arm, person, random = robot.Arm(), robot.Person(), np.random.default_rng(1)
    person.reset("arm", 1)
    successes = episodes(arm, person.act, range(16))
    failures = episodes(arm, lambda _: random.uniform(-1.0, 1.0, 2), range(8))
    classifier = example.fitted(successes[:12], failures[:6])
    found, wrong = example.judged(classifier, successes[12:], failures[6:])
    assert found == 4
    assert wrong <= 1  # a little too early
