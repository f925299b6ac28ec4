"""Make the pictures of the page that the documentation shows, from short runs: `make screenshots`.

It needs Debian's chromium and playwright (the extra `browser`).
"""

import argparse
import importlib
import re
import shutil
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from typing import Any

from PIL import Image

COMMAND = [sys.executable, "-P", "-c", "from daedalus.cli.main import main; raise SystemExit(main())"]
SETTINGS = ["--set", "training.stop_when_solved=false", "--env-steps", "4000000", "--set", "evaluation.seconds=8"]
SETTINGS += ["--set", "collection.envs_per_actor=8"]  # slow enough for a curve
COLOURS = 256  # of a picture: small files
LIMIT = 120_000  # milliseconds for each step


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=45.0, help="duration of the run (default: %(default)s)")
    parser.add_argument("--output", type=Path, default=Path("docs/images"), help="folder (default: %(default)s)")
    parsed = parser.parse_args()
    parsed.output.mkdir(parents=True, exist_ok=True)
    for preset, settings, take in (("cartpole", SETTINGS, _take), ("connect_four", [], _take_match)):
        with tempfile.TemporaryDirectory() as folder:
            words = [*COMMAND, "train", preset, "--watch", "--run-dir", f"{preset}-s1", *settings]
            run = subprocess.Popen(words, cwd=folder, stdout=subprocess.PIPE, text=True)
            try:
                address = page_address(run)
                token = (Path(folder) / f"{preset}-s1" / "operator-token").read_text().strip()
                take(address, token, parsed.output, parsed.seconds)
            finally:
                run.terminate()
                run.wait()


def page_address(run: subprocess.Popen[str]) -> str:
    """Return the address of the page of a run, and read the rest of its output on a thread."""
    assert run.stdout is not None
    for line in run.stdout:
        if match := re.search(r"watch the run at (\S+)", line):
            threading.Thread(target=run.stdout.read, daemon=True).start()
            return match[1]
    raise SystemExit("the run did not start")


def _take(address: str, token: str, folder: Path, seconds: float) -> None:
    sync_api: Any = importlib.import_module("playwright.sync_api")  # an extra
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1200, "height": 900}, color_scheme="light")
        page.goto(address)
        page.locator("#token").fill(token)
        page.get_by_role("button", name="Open").click()
        page.wait_for_timeout(1000 * seconds)
        page.screenshot(path=str(folder / "page_light.png"))
        _shrink(folder / "page_light.png")
        browser.close()


def _take_match(address: str, token: str, folder: Path, seconds: float) -> None:
    """Play some moves against the policy of a run that has trained for a while."""
    sync_api: Any = importlib.import_module("playwright.sync_api")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 620, "height": 720}, color_scheme="light")
        page.wait_for_timeout(1000 * seconds)
        page.goto(f"{address}match")
        page.locator("#token").fill(token)
        page.get_by_role("button", name="Open").click()
        page.get_by_role("button", name="Begin a match").click(timeout=LIMIT)
        for column in (3, 2, 4, 3, 2):
            page.wait_for_selector("#board [aria-disabled=false]", timeout=LIMIT)
            page.locator(f"#board [aria-disabled=false]:nth-child(7n+{column + 1})").first.click()
            page.wait_for_timeout(1000)
        page.screenshot(path=str(folder / "page_match.png"))
        _shrink(folder / "page_match.png")
        browser.close()


def _shrink(path: Path) -> None:
    with Image.open(path) as image:
        image.convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE).save(path, optimize=True)
    print(f"wrote {path}: {path.stat().st_size / 1024:.0f} KiB")


if __name__ == "__main__":
    main()
