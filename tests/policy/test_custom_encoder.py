"""Code of users: encoders of their own, and which modules may be imported."""

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from plain import NAME, act, array_space
from policies import make_policy, observations, spaces
from torch import nn

from daedalus.policy.acting.noise import draw_noise
from daedalus.policy.acting.program import export_program
from daedalus.policy.acting.runtime import OnnxRuntime
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.policy.user_modules import ModuleNotAllowedError, NetworkError, UserModuleError, UserModules
from daedalus.protocol.spaces import ArraySpace, DiscreteSpace, Spaces
from daedalus.protocol.spec import EnvironmentSpec, PolicySpec, RunSpec

PREAMBLE = """
import torch
from torch import nn

class Base(nn.Module):
    def __init__(self, shape):
        super().__init__()
        self.shape = shape
        self.convolution = nn.Conv2d(shape[0], 6, 3, stride=2)

    def forward(self, observations):
        return self.convolution(observations.float() / 255).relu().flatten(1)
"""
SPACES = spaces((9, 11), frames=3)

Building = Callable[..., ActorCritic]


@pytest.fixture
def build(tmp_path: Path) -> Building:
    """Return a function that builds the network with class `Net` of a source, a module in the working directory."""

    def from_source(source: str, where: Spaces = SPACES, **policy: Any) -> ActorCritic:
        (tmp_path / "users_own.py").write_text(PREAMBLE + source)
        spec = PolicySpec(encoder="users_own:Net", **policy)
        return ActorCritic(spec, where, UserModules(frozenset({"users_own"})))

    return from_source


def test_class_in_the_working_directory_is_imported_and_exported(build: Building) -> None:
    network = build("class Net(Base): pass")
    assert network.encoder.features == 6 * 4 * 5
    assert network.convolutional
    policy = make_policy({"encoder": "users_own:Net", "memory": "gru", "memory_units": 8}, SPACES)
    runtime, weights = OnnxRuntime(policy.program), policy.weights()
    policy.load(weights)
    runtime.load(weights)
    seen, states = policy.observations(5), policy.states(5)
    with torch.no_grad():
        logits, expected = policy.network.step({NAME: torch.from_numpy(seen)}, torch.from_numpy(states))
    actions, log_probs, state = act(runtime, seen, states, np.random.default_rng(0))
    np.testing.assert_allclose(state, expected.numpy(), atol=1e-5)
    np.testing.assert_allclose(log_probs, logits.log_softmax(-1).numpy()[np.arange(5), actions], atol=1e-5)


def test_encoder_receives_the_stacked_shape_and_raw_observations(build: Building) -> None:
    network = build(
        """
class Net(Base):
    features = 120
    def forward(self, observations):
        assert type(self.shape) is tuple and self.shape == (3, 9, 11)
        assert observations.dtype == torch.uint8 and observations.shape[1:] == self.shape
        return super().forward(observations)
"""
    )
    seen = torch.full((2, 4, 3, 9, 11), 7, dtype=torch.uint8)
    logits, _ = network({NAME: seen}, torch.zeros(4, 0), torch.zeros(2, 4, dtype=torch.bool))
    assert logits.shape == (2, 4, 4)


EMBEDDING = """
class Net(nn.Module):
    def __init__(self, shape):
        super().__init__()
        self.cells = nn.Embedding(11, 4)

    def forward(self, observations):
        return self.cells(observations.long()).flatten(1)
"""


def test_encoder_receives_bytes_as_they_are_although_observations_are_normalised(build: Building) -> None:
    """Such as the grid of MiniGrid, whose cells are numbers of kinds, and which is too small for an image."""
    where = Spaces(observations={NAME: ArraySpace(shape=(7, 7, 3), dtype="uint8")}, actions=SPACES.actions)
    network = build(EMBEDDING, where, normalize_observations=True)
    cells = torch.randint(0, 11, (2, 1, 7, 7, 3), dtype=torch.uint8)
    assert network.normalizer.names == ()
    parameters, _ = network.step({NAME: cells.flatten(0, 1)}, torch.zeros(2, 0))
    assert parameters.isfinite().all()
    assert export_program(network, where)


def test_encoder_of_several_components_receives_maps_and_is_exported(build: Building) -> None:
    where = Spaces(
        observations={
            "camera": ArraySpace(shape=(9, 11), dtype="uint8", frames=3),
            "goal": DiscreteSpace(counts=(3, 700)),
        },
        actions={"action": DiscreteSpace(counts=(4,))},
    )
    network = build(
        """
class Net(nn.Module):
    def __init__(self, shapes):
        super().__init__()
        assert shapes == {"camera": (3, 9, 11), "goal": (2,)}, shapes
        self.camera, self.goal = Base(shapes["camera"]), nn.Embedding(700, 5)

    def forward(self, observations):
        assert observations["goal"].dtype == torch.int64  # as an embedding requires
        return torch.cat([self.camera(observations["camera"]), self.goal(observations["goal"][:, 1])], 1)
""",
        where,
    )
    runtime = OnnxRuntime(export_program(network, where))
    runtime.load({name: parameter.detach().numpy() for name, parameter in network.named_parameters()})
    random = np.random.default_rng(0)
    seen = {
        "camera": random.integers(0, 256, (5, 3, 9, 11), np.uint8),
        "goal": np.stack([random.integers(0, 3, 5), random.integers(300, 700, 5)], 1).astype(np.uint16),
    }
    choice = runtime.act(seen, np.zeros((5, 0), np.float32), draw_noise(runtime.noise_size, 5, random), {})
    with torch.no_grad():
        tensors = {"camera": torch.from_numpy(seen["camera"]), "goal": torch.from_numpy(seen["goal"].astype(np.int64))}
        parameters, _ = network.step(tensors, torch.zeros(5, 0))
        actions = {name: torch.from_numpy(values) for name, values in choice.actions.items()}
        expected = network.distribution.log_prob(parameters, actions, {})
    np.testing.assert_allclose(choice.log_probs, expected.numpy(), atol=1e-5)


@pytest.mark.parametrize("name", ["not_there_at_all:Net", "not_there.at_all:Net"])
def test_missing_module_is_reported(name: str) -> None:
    with pytest.raises(NetworkError, match=rf"policy\.encoder={name}: cannot import .*"):
        ActorCritic(PolicySpec(encoder=name), SPACES, UserModules(frozenset({name.split(":")[0]})))


def test_the_module_of_an_encoder_is_not_imported_unless_it_is_allowed(build: Building, tmp_path: Path) -> None:
    build("class Net(Base): pass")
    del sys.modules["users_own"]
    with pytest.raises(
        NetworkError, match=r"policy\.encoder=users_own:Net, but the module users_own may not be imported"
    ):
        ActorCritic(PolicySpec(encoder="users_own:Net"), SPACES)
    assert "users_own" not in sys.modules


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("import not_installed_at_all", "users_own.py imports not_installed_at_all, which is not installed"),
        ("class net(Base): pass", r"users_own.py has no 'Net'"),
        ("def Net(shape): return Base(shape)", "is not a class of torch.nn.Module"),
        ("class Net(Base):\n    def __init__(self): pass", "TypeError: "),
        (
            "class Net(Base):\n    def forward(self, x): raise KeyError('mine')",
            r"KeyError: 'mine' \(.*users_own\.py, line \d+\)",
        ),
        ("class Net(Base):\n    def forward(self, x): return self.convolution(x.float())", "must return .2, features."),
        ("class Net(Base):\n    def forward(self, x): return super().forward(x).sum(0)", "must return .2, features."),
        ("class Net(Base):\n    def forward(self, x): return None", "returns NoneType for 2 observations"),
        ("class Net(Base):\n    def forward(self, x): return super().forward(x)[:1]", r"returns \(1, 120\)"),
        ("class Net(Base):\n    def forward(self, x): return super().forward(x).double()", "must return torch.float32"),
        ("class Net(Base):\n    features = 7", r"features=7 but returns \(2, 120\)"),
        (
            "class Net(Base):\n    def __init__(self, s): super().__init__(s); self.norm = nn.BatchNorm2d(3)",
            "norm.*Layer",
        ),
        ("raise RuntimeError('at import')", "RuntimeError: at import"),
        ("class Net(Base:", "SyntaxError"),
    ],
)
def test_invalid_encoder_is_rejected_with_one_line(build: Building, source: str, message: str) -> None:
    with pytest.raises(NetworkError, match=rf"policy\.encoder=users_own:Net: .*{message}") as caught:
        build(source)
    assert "\n" not in str(caught.value)


def test_the_error_of_an_encoder_states_its_input(build: Building) -> None:
    with pytest.raises(NetworkError) as caught:
        build("class Net(Base):\n    def forward(self, x): return self.convolution(x.permute(0, 3, 1, 2).float())")
    assert str(caught.value).endswith(
        "; it is constructed with the shape (3, 9, 11), and called with observations [N, 3, 9, 11] of uint8 from 0 to "
        "255, not scaled, axes as in the environment, 3 frames first"
    )


@pytest.mark.parametrize(
    ("normalize", "numbers"), [(True, "normalised by policy.normalize_observations"), (False, "not scaled")]
)
def test_the_error_of_an_encoder_states_what_is_normalised(build: Building, normalize: bool, numbers: str) -> None:
    arrays: dict[str, ArraySpace | DiscreteSpace] = {
        "cells": ArraySpace(shape=(7, 7, 3), dtype="uint8"),
        "depth": ArraySpace(shape=(20, 20), dtype="float32"),  # images are uint8
    }
    with pytest.raises(NetworkError) as caught:
        build(
            "class Net(nn.Module):\n    def __init__(self, shapes): raise ValueError",
            Spaces(observations=arrays, actions=SPACES.actions),
            normalize_observations=normalize,
        )
    assert str(caught.value).endswith(
        "; it is constructed with a dict of shapes by name, and called with a dict of observations: "
        "cells: [N, 7, 7, 3] of uint8 from 0 to 255, not scaled, axes as in the environment, "
        f"depth: [N, 20, 20] of float32, {numbers}, axes as in the environment"
    )


FORWARD = """
class Net(Base):
    def __init__(self, shape):
        super().__init__(shape)
        self.first, self.tied = nn.Linear(120, 120), nn.Linear(120, 120)
        self.tied.weight = self.first.weight
        self.constant = torch.linspace(-1, 1, 120)

    def forward(self, observations):
        x = super().forward(observations)
        return """


COUNT = """

    def count(self):
        self.calls = getattr(self, "calls", 0) + 1
        return self.calls
"""


@pytest.mark.parametrize(
    ("returned", "message"),
    [
        ("x if observations.float().mean() > 9 else -x", "other features than its exported program"),
        (
            "x + torch.tensor(observations.flatten(1).float().mean(1).tolist())[:, None]",
            "another number of rows: .*tolist",
        ),
        ("x - x.mean(0)", "alone in its call: .*batch_first=True"),
        ("x + torch.zeros(len(x), 120)", r"another number of rows: write observations\.shape\[0\]"),
        ("x + torch.randn_like(x)", "called again with the same observations"),
        ("x + self.count()", "called again with the same observations"),
    ],
)
def test_encoder_that_actors_would_compute_in_another_way_is_rejected(
    build: Building, returned: str, message: str
) -> None:
    with pytest.raises(NetworkError, match=message) as caught:
        build(FORWARD + returned + COUNT)
    assert "\n" not in str(caught.value)


def test_encoder_with_attention_dropout_and_code_over_shapes_is_accepted(
    build: Building, caplog: pytest.LogCaptureFixture
) -> None:
    source = FORWARD.replace(
        "self.constant =",
        "self.attention = nn.TransformerEncoderLayer(12, 2, 16, batch_first=True)\n        self.constant =",
    )
    network = build(source + "self.attention(x.view(-1, 10, 12)).flatten(1) if x.shape[1] == 120 else None")
    assert all(module.training for module in network.encoder.modules())  # the learner has dropout
    (warned,) = caplog.messages
    assert "vary from call to call" in warned
    export_program(network, SPACES)


def test_shared_weights_and_constants_are_exported(build: Building, caplog: pytest.LogCaptureFixture) -> None:
    network = build(FORWARD + "self.tied(self.first(x) * self.constant)")
    assert not caplog.messages
    for parameter in network.parameters():
        nn.init.normal_(parameter, 0.0, 0.2)
    runtime = OnnxRuntime(export_program(network, SPACES))
    runtime.load({name: parameter.detach().numpy() for name, parameter in network.named_parameters()})
    seen = observations(array_space(SPACES), (3,))
    _, log_probs, _ = act(runtime, seen, np.zeros((3, 0), np.float32))
    with torch.no_grad():
        logits, _ = network.step({NAME: torch.from_numpy(seen)}, torch.zeros(3, 0))
    np.testing.assert_allclose(log_probs, logits.log_softmax(-1).amax(-1).numpy(), atol=1e-4)


@pytest.mark.parametrize(
    ("returned", "message"),
    [
        ("torch.special.i0e(x)", "cannot be exported to ONNX"),
        ("torch.atan(x.double()).float()", "actors cannot run the program of the policy: the program cannot be run"),
    ],
)
def test_encoder_that_cannot_be_exported_is_rejected(build: Building, returned: str, message: str) -> None:
    network = build(FORWARD + returned)
    with pytest.raises(NetworkError, match=message) as caught:
        export_program(network, SPACES)
    assert "\n" not in str(caught.value)


@pytest.fixture(autouse=True)
def _restored(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    before = {**sys.modules}
    yield
    for name in sys.modules.keys() - before.keys():  # of the test's own: parts of torch imported late must stay
        if str(tmp_path) in str(getattr(sys.modules[name], "__file__", "")):
            del sys.modules[name]


def test_an_allowed_module_is_imported_from_the_working_directory(tmp_path: Path) -> None:
    (tmp_path / "mine_to_import.py").write_text("value = 7")
    assert UserModules(frozenset({"mine_to_import"})).attribute("environment.wrap", "mine_to_import:value") == 7


@pytest.mark.parametrize("allowed", ["", "mine_not_to_import.part", "mine_not_to"])
def test_no_other_module_is_imported_even_if_it_was_before(tmp_path: Path, allowed: str) -> None:
    (tmp_path / "mine_not_to_import.py").write_text("raise SystemError")
    modules = UserModules(frozenset({allowed}), "the learner")
    with pytest.raises(ModuleNotAllowedError) as refused:
        modules.load("environment.id", "mine_not_to_import:Id")
    assert str(refused.value) == (
        "the learner asks for environment.id=mine_not_to_import:Id, but the module mine_not_to_import may not be "
        "imported here; if you trust that code, add --allow-module mine_not_to_import"
    )
    with pytest.raises(ModuleNotAllowedError):
        modules.attribute("environment.wrap", "os:system")


def test_all_missing_modules_are_named_once() -> None:
    environment = EnvironmentSpec(id="corridor:A-v0", wrap="corridor:wrap")
    spec = RunSpec(environment=environment, policy=PolicySpec(encoder="nets.deep:Net"))
    with pytest.raises(
        ModuleNotAllowedError, match=r"corridor and nets.deep .* --allow-module corridor --allow-m"
    ) as one:
        UserModules().check(spec.user_modules)
    assert one.value.modules == ("corridor", "nets.deep")
    UserModules(frozenset(one.value.modules)).check(spec.user_modules)
    UserModules().check(RunSpec(environment=EnvironmentSpec(id="ALE/Pong-v5")).user_modules)


def failure(value: str) -> str:
    """Return the error of a module that is allowed."""
    with pytest.raises(UserModuleError) as error:
        UserModules(frozenset({value.rpartition(":")[0]})).attribute("environment.wrap", value)
    return str(error.value).removeprefix(f"environment.wrap={value}: ")


def test_a_missing_module_or_name_is_reported(tmp_path: Path) -> None:
    (tmp_path / "mine_without_it.py").write_text("")
    assert failure("__main__:f") == "name the module of the file, without .py, in place of __main__"
    (tmp_path / "mine_that_ends.py").write_text("import argparse; argparse.ArgumentParser().parse_args(['--wrong'])")
    assert failure("mine_that_ends:f").startswith("mine_that_ends ends the process when it is imported: begin what it")
    assert failure("mine_that_is_absent:f").endswith("install it, or start in the folder of mine_that_is_absent.py")
    assert "cannot import mine_absent.part (No module" in failure("mine_absent.part:f")
    assert failure("mine_without_it:f") == "mine_without_it.py has no 'f'"


def test_a_module_that_imports_a_missing_one_is_not_said_to_be_missing(tmp_path: Path) -> None:
    (tmp_path / "mine_with_a_gap.py").write_text("import not_installed_at_all.part")
    (tmp_path / "mine_above_it.py").write_text("import mine_with_a_gap")
    (tmp_path / "mine_with_an_old_name.py").write_text("\nfrom os import absent")
    imports = "mine_with_a_gap.py imports not_installed_at_all, which is not installed"
    assert failure("mine_with_a_gap:f") == failure("mine_above_it:f") == imports
    reason = failure("mine_with_an_old_name:f")
    assert reason.startswith(
        "cannot import mine_with_an_old_name (mine_with_an_old_name.py, line 2: cannot import name"
    )


def test_the_path_of_a_file_in_place_of_a_module_is_reported() -> None:
    write = "name the module, not its file: write "
    assert failure("mine.py:f") == f"{write}mine:f"
    assert failure("envs/mine.py:f") == f"{write}envs.mine:f"
    assert failure("/srv/mine.py:f") == "name the module, not its file: start in /srv and write mine:f"


@pytest.mark.parametrize("name", ["colorsys", "time"])  # the second has no file
def test_a_file_with_the_name_of_a_module_of_python_is_reported(name: str, tmp_path: Path) -> None:
    assert "this folder" not in failure(f"{name}:absent")
    (tmp_path / f"{name}.py").write_text("absent = 1")
    assert failure(f"{name}:absent").endswith(
        f"; it was imported in place of {name}.py of this folder: rename your file"
    )
