"""The camera: what it says of an action, the episodes that it plays, and its process."""

import asyncio
import gc
import json
import os
import struct
import sys
from contextlib import closing
from ctypes.util import find_library
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from processes import LIMIT
from scripted_learner import POLICY, SPEC, Policy

from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.make import make_environments
from daedalus.actor.environments.transforms import TransformedEnvironment
from daedalus.actor.evaluation.episode_camera import EpisodeCamera, action_facts, jpeg
from daedalus.gateway.learner_link import NewestPolicy
from daedalus.gateway.watching.camera import CameraProcess
from daedalus.gateway.watching.playing_process import PolicySource, frame
from daedalus.policy.acting.runtime import Choice, OnnxRuntime
from daedalus.policy.user_modules import NO_MODULES
from daedalus.protocol.messages import Snapshot, Welcome, program_hash
from daedalus.protocol.spaces import ArraySpace, ContinuousSpace, DiscreteSpace, Spaces
from daedalus.protocol.spec import EnvironmentSpec, RunSpec

COMMAND = (sys.executable, "-P", "-m", "daedalus.launch.camera_process")
STATE = np.zeros((3, 0), np.float32)


def weights() -> dict[str, np.ndarray]:
    return {name: value.detach().numpy() for name, value in POLICY.network.named_parameters()}


def runtime() -> OnnxRuntime:
    made = OnnxRuntime(POLICY.model)
    made.load(weights())
    return made


def policy(spec: RunSpec = SPEC, version: int = 4) -> NewestPolicy:
    welcome = Welcome(run="r", learner_epoch=1, seed=1, epsilon=0.0, spec=spec.for_actors())
    name = program_hash(POLICY.model)
    snapshot = Snapshot(learner_epoch=1, policy_version=version, program=name, weights=weights())
    return NewestPolicy(session=welcome, program=POLICY.model, snapshot=snapshot)


def spaces(**actions: DiscreteSpace | ContinuousSpace) -> Spaces:
    return Spaces(observations={"observation": ArraySpace(shape=(1,), dtype="float32")}, actions=actions)


def test_probabilities_of_the_only_choice_are_those_of_the_program() -> None:
    choice = Choice({"action": np.array([[1], [0], [1]])}, np.log(np.array([0.75, 0.25, 0.75], np.float32)), STATE)
    (facts,) = action_facts(spaces(action=DiscreteSpace(counts=(3,))), choice)
    assert facts == {"name": "action", "choices": [["0", 0.25, False], ["1", 0.75, True], ["2", 0.0, False]]}


def test_choices_have_the_names_that_the_environment_gives() -> None:
    choice = Choice({"action": np.array([[1], [0]])}, np.log(np.array([0.75, 0.25], np.float32)), STATE)
    two = spaces(action=DiscreteSpace(counts=(2,)))
    (facts,) = action_facts(two, choice, ("left", "right"))
    assert facts["choices"] == [["left", 0.25, False], ["right", 0.75, True]]
    (facts,) = action_facts(two, choice, ("left", "stay", "right"))  # they are of other actions
    assert facts["choices"] == [["0", 0.25, False], ["1", 0.75, True]]
    environments = make_environments(EnvironmentSpec(id="MiniGrid-Empty-5x5-v0", leave_out=("mission",)), 1)
    environments.close()
    assert isinstance(environments, TransformedEnvironment)
    assert environments.action_names[:3] == ("left", "right", "forward")


def test_probabilities_of_several_variables_are_shares_of_the_samples() -> None:
    choice = Choice(
        {"action": np.array([[1, 2], [0, 2], [1, 2], [1, 0], [1, 2]])}, np.zeros(5, np.float32), np.zeros((5, 0))
    )
    first, second = action_facts(spaces(action=DiscreteSpace(counts=(2, 3))), choice)
    assert first["choices"] == [["0", 0.25, False], ["1", 0.75, True]]
    assert second["choices"] == [["0", 0.25, False], ["1", 0.0, False], ["2", 0.75, True]]


def test_numbers_are_shown_with_the_spread_of_the_samples() -> None:
    choice = Choice({"arm": np.array([[0.5], [1.0], [3.0]], np.float32)}, np.zeros(3, np.float32), STATE)
    (facts,) = action_facts(spaces(arm=ContinuousSpace(low=(None,), high=(None,))), choice)
    assert facts == {"name": "arm", "numbers": [[0.5, 1.0]]}


def test_of_very_many_choices_the_likely_ones_are_shown() -> None:
    taken = np.array([[900], [3], [900]])
    choice = Choice({"action": taken}, np.log(np.array([0.2, 0.1, 0.2], np.float32)), STATE)
    (facts,) = action_facts(spaces(action=DiscreteSpace(counts=(1000,))), choice)
    assert facts["choices"] == [["3", 0.1, False], ["900", 0.2, True]]


def test_an_episode_is_played_with_pictures() -> None:
    with closing(EpisodeCamera(SPEC.for_actors(), NO_MODULES)) as camera:
        moments = list(camera.play(runtime()))
        again = next(camera.play(runtime()))
    assert [moment.step for moment in moments] == list(range(1, len(moments) + 1))
    assert moments[-1].total == len(moments)
    assert again.step == 1
    shares = [share for _, share, _ in moments[0].actions[0]["choices"]]
    assert sum(shares) == pytest.approx(1.0, abs=1e-3)
    assert sum(taken for _, _, taken in moments[0].actions[0]["choices"]) == 1
    assert jpeg(moments[0].picture)[:3] == b"\xff\xd8\xff"


def test_all_agents_of_a_game_are_played_and_their_actions_named() -> None:
    game = SPEC.environment.model_copy(update={"id": "pettingzoo.classic.tictactoe_v3", "backend": "pettingzoo"})
    spec = SPEC.model_copy(update={"environment": game})
    with closing(EpisodeCamera(spec.for_actors(), NO_MODULES, lambda observations, state: float(len(state)))) as camera:
        policy = Policy.of(spec.policy, camera.spaces)
        acting = OnnxRuntime(policy.model)
        acting.load({name: value.detach().numpy() for name, value in policy.network.named_parameters()})
        moments = list(camera.play(acting))
    names = [[fact["name"] for fact in moment.actions] for moment in moments]
    assert names == [[f"player_{1 + number % 2} action"] for number in range(len(moments))]
    taken = [choice for moment in moments for choice, _, was_taken in moment.actions[0]["choices"] if was_taken]
    assert len(set(taken)) == len(moments) >= 5  # no field twice
    # Of nine equally probable fields, one is in none of the 64 samples in one of 200 runs.
    assert all(0.5 < sum(share for _, share, _ in moment.actions[0]["choices"]) < 1.001 for moment in moments)
    assert {moment.value for moment in moments} == {1.0}
    assert (moments[0].picture != moments[-1].picture).any()


@pytest.mark.skipif(find_library("EGL") is None, reason="libEGL is not installed")
def test_mujoco_is_rendered_without_a_display(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mujoco")
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL"):
        monkeypatch.delenv(name, raising=False)
    spec = SPEC.model_copy(update={"environment": SPEC.environment.model_copy(update={"id": "InvertedPendulum-v5"})})
    with closing(EpisodeCamera(spec.for_actors(), NO_MODULES)) as camera:
        policy = Policy.of(spec.policy, camera.spaces)
        acting = OnnxRuntime(policy.model)
        acting.load({name: value.detach().numpy() for name, value in policy.network.named_parameters()})
        moment = next(camera.play(acting))
    assert moment.picture.std() > 1.0, "a picture, not one colour"
    assert len(moment.actions[0]["numbers"]) == 1


def test_large_pictures_are_made_smaller() -> None:
    with Image.open(BytesIO(jpeg(np.zeros((900, 1800, 3), np.uint8)))) as image:
        assert image.size == (640, 320)


def test_module_that_is_not_allowed_is_not_imported() -> None:
    spec = SPEC.model_copy(update={"environment": SPEC.environment.model_copy(update={"id": "evil:Evil-v0"})})
    with pytest.raises(EnvironmentSetupError, match="may not be imported here"):
        EpisodeCamera(spec.for_actors(), NO_MODULES)


def facts_of(frame: bytes) -> dict[str, Any]:
    (length,) = struct.unpack_from("<I", frame)
    return json.loads(frame[4 : 4 + length])


def test_the_process_runs_while_somebody_watches_only() -> None:
    async def watch() -> None:
        newest: list[NewestPolicy | None] = [None]
        camera = CameraProcess(COMMAND, PolicySource(lambda: newest[0]))
        frames = camera.frames()
        async with asyncio.timeout(LIMIT):
            assert "no policy yet" in facts_of(await anext(frames))["error"]
            newest[0] = policy()
            while "error" in (facts := facts_of(frame := await anext(frames))):
                pass
            assert facts["version"] == 4
            assert frame[-2:] == b"\xff\xd9"  # a complete JPEG
            newest[0] = _newer(newest[0])
            while facts_of(await anext(frames))["version"] == 4:
                pass
            (process,) = children()
            await frames.aclose()
            while children() == [process]:
                await asyncio.sleep(0.05)
            await camera.close()

    asyncio.run(watch())
    assert children() == []


def _newer(old: NewestPolicy | None) -> NewestPolicy:
    assert old is not None
    return NewestPolicy(session=old.session, program=old.program, snapshot=policy(version=5).snapshot)


def children() -> list[int]:
    """Return the ids of the camera processes of this test."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((entry / "stat").read_text().rsplit(")", 1)[1].split()[1])
            words = (entry / "cmdline").read_bytes().split(b"\0")
        except OSError:
            continue
        if parent == os.getpid() and b"daedalus.launch.camera_process" in words:
            found.append(int(entry.name))
    return found


def test_the_page_is_told_why_there_is_no_picture() -> None:
    spec = SPEC.model_copy(update={"environment": SPEC.environment.model_copy(update={"id": "None-v0"})})

    newest = policy(spec)

    async def watch() -> str:
        camera = CameraProcess(COMMAND, PolicySource(lambda: newest))
        frames = camera.frames()
        async with asyncio.timeout(LIMIT):
            facts = facts_of(await anext(frames))
        await frames.aclose()
        await camera.close()
        return facts["error"]

    assert "The camera cannot play: " in asyncio.run(watch())


FLOOD = "import struct, sys\nwhile True: sys.stdout.buffer.write(struct.pack('<I', 300_000) + bytes(300_000))"
ONE = "import struct, sys\nsys.stdout.buffer.write(struct.pack('<I', 4) + bytes(4)); sys.stdout.flush(); input()"


async def watched_for_a_frame(program: str) -> CameraProcess:
    """Return the camera of a Python program that somebody watched until its first frame."""
    newest = policy()
    camera = CameraProcess((sys.executable, "-c", program), PolicySource(lambda: newest))
    frames = camera.frames()
    async with asyncio.timeout(LIMIT):
        await anext(frames)
        await frames.aclose()
    return camera


def test_a_process_whose_frames_were_not_all_read_leaves_no_pipe_open() -> None:
    async def watch() -> None:
        gc.collect()  # closes what earlier tests left
        before = open_files()
        camera = await watched_for_a_frame(FLOOD)
        async with asyncio.timeout(LIMIT):
            await camera.close()
            while open_files() > before:
                await asyncio.sleep(0.05)

    asyncio.run(watch())


@pytest.mark.parametrize("program", [FLOOD, ONE], ids=["flood", "one frame"])
def test_a_loop_that_ends_while_the_process_is_ended_leaves_nothing(program: str) -> None:
    """A transport that is not closed complains when it is collected: in another test, of this process."""
    gc.collect()  # closes what earlier tests left
    before = open_files()
    asyncio.run(watched_for_a_frame(program))
    gc.collect()
    assert open_files() == before


def open_files() -> int:
    return len(os.listdir("/dev/fd"))


def test_facts_that_json_does_not_have_are_null() -> None:
    data = frame({"reward": np.nan, "total": -np.inf, "actions": [{"numbers": [(1.0, np.inf)]}]}, b"jpeg")
    (length,) = struct.unpack("<I", data[:4])
    facts = json.loads(data[4 : 4 + length])
    assert facts == {"reward": None, "total": None, "actions": [{"numbers": [[1.0, None]]}]}
    assert data.endswith(b"jpeg")
