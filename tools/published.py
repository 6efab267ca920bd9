"""Write docs/published.md, the table of published results beside ours, from docs/published/*.json.

With `--check`, write nothing and exit with 1 when the page is not what the files say.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from statistics import median
from textwrap import wrap
from typing import Any

from ctmhe.studies.reproduce import PAPERS

DOCS = Path(__file__).resolve().parents[1] / "docs"
PAGE, FOLDER = DOCS / "published.md", DOCS / "published"
HEAD = """# Published results beside ours

Written by `tools/published.py` from what `ctmhe reproduce all --jobs 2 --json docs/published` writes; not edited by
hand. The files hold the settings too. A value is compared where paper and case have one in the same place; means over
seeds carry their standard deviation in parentheses. Computing times are those of the machine that ran the case; they
are shown and not compared. [reproduced.md](reproduced.md) has the certificates and our own studies in words.

"""
TIMES = ("ms", "tau", "time", "seconds")


def leaves(value: Any, where: tuple[Any, ...] = ()) -> dict[tuple[Any, ...], Any]:
    """Return the numbers and texts of a nested result by their place; {"mean", "std"} counts as one."""
    if isinstance(value, dict) and not ("mean" in value and set(value) <= {"mean", "std", "n"}):
        pairs = value.items()
    elif isinstance(value, list):
        pairs = enumerate(value)
    else:
        return {where: value}
    found: dict[tuple[Any, ...], Any] = {}
    for key, inner in pairs:
        found |= leaves(inner, (*where, key))
    return found


def number(value: Any) -> float | None:
    """Return a leaf as a number, if it is one."""
    if isinstance(value, dict):
        value = value["mean"]
    return float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else None


def said(value: Any) -> str:
    """Return a leaf as text."""
    if value is None:
        return "–"
    if isinstance(value, dict):
        spread = f" ({value['std']:.2g})" if value.get("std") is not None else ""
        return f"{value['mean']:.4g}{spread}" if value["mean"] is not None else "–"
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return str(value).replace("|", "\\|")
    return f"{value:d}" if isinstance(value, int) else f"{value:.4g}"


def is_time(where: tuple[Any, ...]) -> bool:
    """Whether a place holds a computing time."""
    return any(isinstance(key, str) and any(word in key.lower().split("_") for word in TIMES) for key in where)


def compared(result: dict[str, Any]) -> list[tuple[tuple[Any, ...], Any, Any]]:
    """Return place, published and our value wherever both have a number."""
    ours = leaves(result["ours"])
    pairs = [(where, value, ours[where]) for where, value in leaves(result["published"]).items() if where in ours]
    return [pair for pair in pairs if number(pair[1]) is not None and number(pair[2]) is not None]


def off(published: Any, mine: Any) -> float:
    """Return the relative difference of two leaves."""
    one, other = number(published), number(mine)
    assert one is not None and other is not None
    return abs(other - one) / abs(one) if one else abs(other)


def is_table(value: Any) -> bool:
    """Whether a value is a list of rows."""
    return isinstance(value, list) and bool(value) and all(isinstance(row, dict) for row in value)


def keys_of(rows: list[dict[str, Any]], mine: list[dict[str, Any]]) -> list[str]:
    """Return the columns that say which row it is: the same in both, and no averages."""
    first = [key for key in rows[0] if all(key in row for row in (*rows, *mine))]
    return [key for key in first if all(a[key] == b[key] for a, b in zip(rows, mine, strict=False))]


def rows_of(name: tuple[Any, ...], published: Any, ours: Any) -> list[str]:
    """Return Markdown of one part of a result: a table beside ours, or lines of single values."""
    if is_table(published) and is_table(ours):
        labels = keys_of(published, ours)
        rest = list(dict.fromkeys(key for row in (*published, *ours) for key in row if key not in labels))
        both = {key: any(row.get(key) is not None for row in published) for key in rest}
        heads = [*labels, *(f"{key}: published / ours" if both[key] else f"{key}, ours" for key in rest)]
        lines = [f"**{' '.join(map(str, name))}**\n"] if name else []
        lines += [f"| {' | '.join(heads)} |", "|" + "---|" * len(heads)]
        for k in range(max(len(published), len(ours))):
            left, right = (rows[k] if k < len(rows) else {} for rows in (published, ours))
            cells = [said((left or right).get(key)) for key in labels]
            for key in rest:
                mine = said(right.get(key))
                cells.append(f"{said(left.get(key))} / {mine}" if both[key] else mine)
            lines.append(f"| {' | '.join(cells)} |")
        return [*lines, ""]
    if isinstance(published, dict) and isinstance(ours, dict) and set(published) != {"mean", "std"}:
        lines, single = [], {}
        for key in dict.fromkeys((*published, *ours)):
            inner = (published.get(key), ours.get(key))
            nested = [value for value in inner if value is not None]
            if any(is_table(v) or (isinstance(v, dict) and "mean" not in v) for v in nested):
                lines += rows_of((*name, key), *(v if v is not None else type(nested[0])() for v in inner))
            elif len(nested) == 2:
                single[key] = inner
        if single:
            head = [f"**{' '.join(map(str, name))}**\n"] if name else []
            table = [f"| {key} | {flat(one)} | {flat(two)} |" for key, (one, two) in single.items()]
            lines = [*head, "| | published | ours |", "|---|---|---|", *table, "", *lines]
        return lines
    return []


def flat(value: Any) -> str:
    """Return a short list or a leaf in one cell."""
    return ", ".join(flat(inner) for inner in value) if isinstance(value, list) else said(value)


def page() -> str:
    """Return the page."""
    files = {name: FOLDER / f"{name}.json" for name in PAPERS}
    results = {name: json.loads(path.read_text("utf-8")) for name, path in files.items() if path.exists()}
    lines = ["| case | values compared | within 1 % | within 10 % | median difference |", "|---|---|---|---|---|"]
    for name, result in results.items():
        found = [off(one, two) for where, one, two in compared(result) if not is_time(where)]
        counts = [sum(d <= limit for d in found) for limit in (0.01, 0.1)]
        cells = [str(len(found)), *map(str, counts), f"{median(found):.2g}"] if found else ["0", "–", "–", "–"]
        lines.append(f"| [`{name}`](#{name.replace('.', '')}) | {' | '.join(cells)} |")
    lines.append("")
    for name, result in results.items():
        lines += [
            f"## {name}",
            "",
            *rows_of((), result["published"], result["ours"]),
            *wrap(result["comment"], 125),
            "",
        ]
    missing = [name for name in PAPERS if name not in results]
    if missing:
        lines += [f"No file yet: {', '.join(missing)}.", ""]
    return HEAD + "\n".join(lines).rstrip() + "\n"


def main() -> int:
    """Write the page, or compare it."""
    text = page()
    if "--check" not in sys.argv[1:]:
        PAGE.write_text(text, encoding="utf-8")
        return 0
    same = PAGE.exists() and PAGE.read_text("utf-8") == text
    verdict = "in step" if same else "not what its files say: run tools/published.py"
    sys.stdout.write(f"docs/published.md is {verdict}\n")
    return 0 if same else 1


if __name__ == "__main__":
    sys.exit(main())
