"""examples/first_steps.ipynb: executed as a reader executes it."""

import re
from pathlib import Path
from typing import Any

import pytest
from processes import LIMIT

import daedalus

NOTEBOOK = Path(__file__).parents[2] / "examples" / "first_steps.ipynb"


@pytest.fixture
def nbformat() -> Any:
    """Import what the notebook needs, which takes a fifth of a second, in the worker of these tests alone."""
    for name in ("nbclient", "ipykernel", "av", "matplotlib"):
        pytest.importorskip(name)
    return pytest.importorskip("nbformat")


def test_the_notebook_is_stored_without_outputs_and_uses_the_public_api_only(nbformat: Any) -> None:
    notebook = nbformat.read(NOTEBOOK, 4)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert not any(cell.outputs or cell.execution_count for cell in code)
    source = "\n".join(cell.source for cell in code)
    assert "from daedalus" not in source
    used = set(re.findall(r"\bdaedalus\.(\w+)", source))
    assert {"train", "read_metrics", "evaluate", "load_policy"} <= used <= set(daedalus.__all__)


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_the_notebook_trains_plots_evaluates_shows_a_video_and_acts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, nbformat: Any
) -> None:
    from nbclient import NotebookClient

    monkeypatch.delenv("MPLBACKEND", raising=False)  # another test of this process may have set it
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    monkeypatch.setenv("JUPYTER_RUNTIME_DIR", str(tmp_path / "jupyter"))
    notebook = nbformat.read(NOTEBOOK, 4)
    (training,) = (cell for cell in notebook.cells if cell.id == "train")
    assert "env_steps=600_000" in training.source
    training.source = training.source.replace("600_000", "30_000")  # a reader has the time to learn it
    client = NotebookClient(notebook, timeout=int(5 * LIMIT), resources={"metadata": {"path": str(tmp_path)}})
    client.execute()
    cells = {cell.id: cell for cell in notebook.cells}
    (run,) = (tmp_path / "runs").iterdir()
    assert "env_steps" in printed(cells["train"])
    assert re.search(r"^return of the best policy: \d+\.\d \+- ", printed(cells["result"]), re.MULTILINE)
    assert any("image/png" in output.get("data", {}) for output in cells["plot"].outputs)
    assert re.search(r"^\d+\.\d \+- \d+\.\d over 20 episodes$", printed(cells["evaluate"]), re.MULTILINE)
    (shown,) = cells["video"].outputs
    assert "data:video/mp4;base64," in shown.data["text/html"]
    assert (run / "replay.mp4").stat().st_size > 1000
    assert re.fullmatch(r"return \d+\n", printed(cells["loop"]))


def printed(cell: Any) -> str:
    return "".join(output.text for output in cell.outputs if output.output_type == "stream")
