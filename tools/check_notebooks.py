"""Check that every notebook and its percent-format `.py` hold the same cells; exit with 1 and the names otherwise."""

from __future__ import annotations

import sys
from pathlib import Path

import jupytext

FOLDER = Path(__file__).resolve().parents[1] / "notebooks"


def cells(path: Path) -> list[tuple[str, str]]:
    """Return kind and text of every cell, outputs left aside."""
    return [(cell.cell_type, cell.source.strip()) for cell in jupytext.read(path).cells]


def difference(stem: str) -> str | None:
    """Return what is wrong with the pair `stem.ipynb`, `stem.py`, or None."""
    notebook, script = FOLDER / f"{stem}.ipynb", FOLDER / f"{stem}.py"
    for path in (notebook, script):
        if not path.exists():
            return f"{path.name} is missing"
    left, right = cells(notebook), cells(script)
    for number, (one, other) in enumerate(zip(left, right, strict=False), start=1):
        if one != other:
            return f"cell {number} differs between {notebook.name} and {script.name}"
    if len(left) != len(right):
        return f"{notebook.name} has {len(left)} cells, {script.name} has {len(right)}"
    return None


def main() -> int:
    """Report every pair that does not match."""
    stems = {path.stem for path in (*FOLDER.glob("*.ipynb"), *FOLDER.glob("*.py"))}
    wrong = [message for stem in sorted(stems) if (message := difference(stem))]
    for message in wrong:
        sys.stderr.write(f"{message}\n")
    if wrong:
        sys.stderr.write("'make notebooks' rewrites the .ipynb from the .py\n")
    else:
        sys.stdout.write(f"{len(stems)} pairs in step\n")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
