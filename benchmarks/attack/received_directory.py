"""Attack: somebody sends a run directory whose files are links to files of the receiver, who resumes the run.

    python -m benchmarks.attack.received_directory

Each file that a run writes leads to a victim's file, by a symbolic or a hard link, or is a FIFO, which nobody reads;
`checkpoints` is a link to a folder, or has folders of the victim's in it; the operator's token is the sender's. A run
that went on in such a directory would overwrite the files, delete the folders, hang, or take the sender's orders.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from benchmarks.attack.verdict import Verdict
from benchmarks.chaos.scene import scene
from benchmarks.running import COMMAND

SLOW = True

_WRITTEN = ("learner.lock", "metrics.csv", "events.jsonl", "output.log", "heartbeat", "config.toml", "operator-token")
_PRECIOUS = "precious, and not of this run"
_TOKEN = "s" * 43
_SECONDS = 60.0


def received_directory() -> Verdict:
    """Resume and evaluate runs in such directories, and return what happened to the victim's files."""
    harmed: list[str] = []
    tried = 0
    with scene() as here:
        budget = ("--actors", "1", "--env-steps", "2000", "--set", "evaluation.final_episodes=1")
        here.start("train", "--env", "CartPole-v1", *budget, "--run-dir", "honest").process.wait(_SECONDS)
        honest, home = here.folder / "honest", here.folder / "home"
        for name, prepare in _attacks().items():
            received = here.folder / "received"
            for folder in (received, home):
                shutil.rmtree(folder, ignore_errors=True)
            shutil.copytree(honest, received)
            (home / "2024").mkdir(parents=True)
            for victim in (home / "file", home / "2024" / "photo"):
                victim.write_text(_PRECIOUS)
            prepare(received, home)
            tried += 1
            for words in (("resume", "received", "--env-steps", "3000"), ("report", "received")):
                try:
                    subprocess.run(
                        [*COMMAND, *words],
                        cwd=here.folder,
                        stdin=subprocess.DEVNULL,
                        capture_output=True,
                        timeout=_SECONDS,
                        check=False,
                    )
                except subprocess.TimeoutExpired:
                    harmed.append(f"{words[0]} hangs at {name}")
            if any(_text(victim) != _PRECIOUS for victim in (home / "file", home / "2024" / "photo")):
                harmed.append(name)
            if _text(received / "operator-token") == _TOKEN:
                harmed.append(f"the sender's token stays: {name}")
    return Verdict(not harmed, f"{tried} directories, of which {len(harmed)} did harm: {', '.join(harmed) or 'none'}")


def _attacks() -> dict[str, Callable[[Path, Path], None]]:
    attacks: dict[str, Callable[[Path, Path], None]] = {}
    kinds: dict[str, Callable[[Path, Path], None]] = {
        "link": lambda path, victim: path.symlink_to(victim),
        "hard link": lambda path, victim: path.hardlink_to(victim),
        "FIFO": lambda path, _: os.mkfifo(path),
    }
    for kind, make in kinds.items():
        for name in _WRITTEN:

            def plant(received: Path, home: Path, name: str = name, make: Callable = make) -> None:
                (received / name).unlink(missing_ok=True)
                make(received / name, home / "file")

            attacks[f"{kind} {name}"] = plant

    def linked_folder(received: Path, home: Path) -> None:
        shutil.rmtree(received / "checkpoints")
        (received / "checkpoints").symlink_to(home)

    def token(received: Path, _: Path) -> None:
        (received / "operator-token").write_text(_TOKEN)

    return {**attacks, "linked checkpoints": linked_folder, "token": token}


def _text(path: Path) -> str:
    return path.read_text() if path.is_file() else ""


if __name__ == "__main__":
    verdict = received_directory()
    print(verdict)
    sys.exit(0 if verdict.held else 1)
