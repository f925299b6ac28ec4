"""The tests that docs/operations.md and docs/security.md name exist, and each failure has one."""

import re
from pathlib import Path

import pytest
from pages import DOCS, ROOT, inline_code

OPERATIONS = (DOCS / "operations.md").read_text("utf-8")


def named_tests(page: str) -> set[str]:
    """Return the tests that a page names: files, or `FILE::FUNCTION`."""
    found = [code for code in inline_code((DOCS / page).read_text("utf-8")) if re.search(r"\btest_\w+\.py", code)]
    return set(found)


@pytest.mark.parametrize(("page", "least"), [("operations.md", 40), ("security.md", 15)])
def test_each_named_test_exists(page: str, least: int) -> None:
    tests = named_tests(page)
    assert len(tests) >= least
    for name in tests:
        path, _, function = name.partition("::")
        paths = [ROOT / path] if "/" in path else list((ROOT / "tests").rglob(path))
        assert paths, name
        assert all(each.exists() for each in paths), name
        assert not function or has_test(paths[0], function), name


def has_test(path: Path, function: str) -> bool:
    """Return whether a file has a test of this name."""
    return re.search(rf"^def {function}\(", path.read_text("utf-8"), re.MULTILINE) is not None


def test_each_failure_has_a_test() -> None:
    failures, _, table = OPERATIONS.partition("## Failures and what happens")[2].partition("## Tests of these promises")
    titles = re.findall(r"^\*\*([^*]+?)\.?\*\*", failures, re.MULTILINE)
    assert len(titles) > 20
    rows = dict(re.findall(r"^\| ([^|]+) \| (`tests/.*`) \|$", table, re.MULTILINE))
    assert set(titles) <= rows.keys()
