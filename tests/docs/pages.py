"""The documentation as text, for the tests that check what it says against the code."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = sorted(
    [
        *DOCS.rglob("*.md"),
        *ROOT.glob("*.md"),
        ROOT / "policy" / "pretrained" / "car_racing" / "README.md",
    ]
)


def name_of(page: Path) -> str:
    """Return a page's path from the repository's root, as a test's id."""
    return page.relative_to(ROOT).as_posix()


def code_blocks(text: str, language: str = "") -> list[str]:
    """Return the contents of the fenced blocks of one language, or of those without one."""
    blocks = re.findall(r"^```(\w*)\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    return [block for found, block in blocks if found == language]


def inline_code(text: str) -> list[str]:
    """Return what stands in single backticks, line breaks as spaces."""
    prose = re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    return [" ".join(code.split()) for code in re.findall(r"`([^`]+)`", prose)]
