"""Compare the fast backend of CarRacing-v3 with gymnasium's, frame by frame, in one episode.

    python -m benchmarks.side_by_side --output docs/car_racing_frames.png

Both get the same seed and the same actions. Prints the difference of the frames in grey values, and whether rewards and
ends are equal. The picture shows frames of gymnasium, frames of the fast backend, and ten times the difference.
"""

import argparse
from pathlib import Path

import numpy as np
from PIL import Image

from daedalus.actor.environments.make import make_environments
from daedalus.actor.environments.vector_environments import VectorEnvironment
from daedalus.learner.run.settings import read_preset, run_spec
from daedalus.protocol.spec import EnvironmentSpec

_ENLARGED = 3


def drive(environments: VectorEnvironment, seed: int, actions: list[int]) -> tuple[np.ndarray, list[tuple]]:
    """Return frames [T, H, W], and reward, terminated and truncated of each step."""
    frames, rest = [environments.reset(seed).frames["observation"][0].copy()], []
    for action in actions:
        shown, rewards, terminated, truncated = environments.step({"action": np.array([[action]])})
        frames.append(shown.frames["observation"][0].copy())
        rest.append((float(rewards[0]), bool(terminated[0]), bool(truncated[0])))
    return np.stack(frames), rest


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--output", type=Path, required=True)
    options.add_argument("--seed", type=int, default=11)
    options.add_argument("--env-steps", type=int, default=200)
    parsed = options.parse_args()
    settings = read_preset("car_racing")["environment"]
    actions = np.random.default_rng(parsed.seed).integers(0, len(settings["action_table"]), parsed.env_steps).tolist()
    spec = run_spec(read_preset("car_racing")).environment.model_copy(
        update={"no_reward_limit": None, "processes": False}
    )
    drives = []
    for backend in ("gymnasium", "fast"):
        environments = make_environments(EnvironmentSpec.model_validate({**dict(spec), "backend": backend}), 1)
        try:
            drives.append(drive(environments, parsed.seed, actions))
        finally:
            environments.close()
    (original, expected), (fast, found) = drives
    apart = np.abs(original.astype(int) - fast)  # [T, H, W]
    worst = apart.mean((1, 2)).max()
    print(f"{len(apart)} frames: mean difference {apart.mean():.2f} of 255, {worst:.2f} in the worst frame")
    print(f"between one frame and the next: {np.abs(np.diff(original.astype(int), axis=0)).mean():.2f}")
    print("rewards and ends are", "equal" if expected == found else "NOT equal")
    moments = np.linspace(0, len(apart) - 1, 6).astype(int)
    columns = [np.concatenate([original[m], fast[m], np.minimum(10 * apart[m], 255)]) for m in moments]
    picture = np.concatenate(columns, axis=1).astype(np.uint8)
    Image.fromarray(picture).resize(np.array(picture.shape[::-1]) * _ENLARGED, Image.Resampling.NEAREST).save(
        parsed.output
    )
    print(f"wrote {parsed.output}")


if __name__ == "__main__":
    main()
