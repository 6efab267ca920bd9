"""The documentation is executed: every Python block of README.md and docs/*.md, each page in one namespace."""

from __future__ import annotations

import importlib
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(r"^```python *\n(.*?)^```", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\[[^\]]*\]\(([^)#\s]+)(?:#[^)]*)?\)")


def names(page: Path) -> str:
    return str(page.relative_to(ROOT))


@pytest.mark.parametrize("page", [page for page in PAGES if BLOCK.search(page.read_text("utf-8"))], ids=names)
def test_the_python_blocks_of_a_page_run_in_order(page, tmp_path, monkeypatch):
    """Blocks marked `python no-run` are shown only; files are written to a scratch folder."""
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("agg")
    monkeypatch.chdir(tmp_path)
    module = ModuleType(f"docs_{page.stem}")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    text = page.read_text("utf-8")
    for block in BLOCK.finditer(text):
        lines_above = text.count("\n", 0, block.start(1))
        exec(compile("\n" * lines_above + block[1], str(page), "exec"), vars(module))
    sys.modules["matplotlib.pyplot"].close("all") if "matplotlib.pyplot" in sys.modules else None


@pytest.mark.parametrize("page", PAGES, ids=names)
def test_relative_links_of_a_page_lead_to_files(page):
    """Every link that is not an address names a file of this repository."""
    targets = [target for target in LINK.findall(page.read_text("utf-8")) if "://" not in target]
    missing = [target for target in targets if not (page.parent / target).exists()]
    assert not missing


RESULTS = {"Predicate", "Watch", "WatchState", "TriggerContext", "Outlook", "ExcitationMeasure", "Or", "Design",
           "Exploration", "Status", "StudyResult", "Threshold", "Direction", "Information", "ExcitationDesign",
           "Growth", "JointBound", "JointCertificate", "JointWeights", "OnlineConditions"}  # fmt: skip
"""What these rooms hand out, not what a user writes."""


@pytest.mark.parametrize(
    "room", ["ctmhe.triggers", "ctmhe.studies", "ctmhe.plotting", "ctmhe.models.library", "ctmhe.certificates"]
)
def test_each_public_name_is_in_an_executed_example(room):
    """A name that no page and no notebook shows is not documented."""
    shown = [block for page in PAGES for block in BLOCK.findall(page.read_text("utf-8"))]
    shown += [path.read_text("utf-8") for path in (ROOT / "notebooks").glob("*.py")]
    words = set(re.findall(r"\w+", "\n".join(shown)))
    assert not set(importlib.import_module(room).__all__) - RESULTS - words
