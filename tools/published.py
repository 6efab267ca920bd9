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


Place = tuple[Any, ...]


def compared(published: Any, ours: Any, where: Place = ()) -> list[tuple[Place, Any, Any]]:
    """Return place, published and our value wherever both have a number; columns that name a table's rows left out."""
    if is_table(published) and is_table(ours):
        labels = keys_of(published, ours)
        rows = zip(published, ours, strict=False)
        pairs = [((k, key), one[key], two[key]) for k, (one, two) in enumerate(rows) for key in one if key in two]
        pairs = [pair for pair in pairs if pair[0][1] not in labels]
    elif isinstance(published, dict) and isinstance(ours, dict) and "mean" not in published:
        pairs = [((key,), published[key], ours[key]) for key in published if key in ours]
    elif isinstance(published, list) and isinstance(ours, list):
        pairs = [((k,), one, two) for k, (one, two) in enumerate(zip(published, ours, strict=False))]
    else:
        known = number(published) is not None and number(ours) is not None
        return [(where, published, ours)] if known else []
    return [found for inner, one, two in pairs for found in compared(one, two, (*where, *inner))]


def number(value: Any) -> float | None:
    """Return a leaf as a number, if it is one."""
    if isinstance(value, dict):
        value = value.get("mean")
    return float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else None


def said(value: Any) -> str:
    """Return a leaf, or a few of them, as text for one cell."""
    if value is None:
        return "–"
    if isinstance(value, dict) and "mean" not in value:
        return "; ".join(f"{key} {said(inner)}" for key, inner in value.items())
    if isinstance(value, list):
        return ", ".join(said(inner) for inner in value)
    if isinstance(value, dict):
        spread = f" ({value['std']:.2g})" if value.get("std") is not None else ""
        return f"{value['mean']:.4g}{spread}" if value["mean"] is not None else "–"
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return str(value).replace("|", "\\|")
    return f"{value:d}" if isinstance(value, int) else f"{value:.4g}"


def is_time(where: Place) -> bool:
    """Whether a place holds a computing time."""
    return any(isinstance(key, str) and any(word in key.lower().split("_") for word in TIMES) for key in where)


def off(published: Any, mine: Any) -> float:
    """Return the relative difference of two leaves."""
    one, other = number(published), number(mine)
    assert one is not None and other is not None
    return abs(other - one) / abs(one) if one else abs(other)


def is_table(value: Any) -> bool:
    """Whether a value is a list of rows."""
    return isinstance(value, list) and bool(value) and all(isinstance(row, dict) for row in value)


def keys_of(rows: list[dict[str, Any]], mine: list[dict[str, Any]]) -> list[str]:
    """Return the leading columns that say which row it is: the same in both, and no averages."""
    found: list[str] = []
    for key in rows[0]:
        if any(key not in row or isinstance(row[key], dict) for row in (*rows, *mine)):
            break
        if any(a[key] != b[key] for a, b in zip(rows, mine, strict=False)):
            break
        found.append(key)
    return found


def rows_of(name: Place, published: Any, ours: Any) -> list[str]:
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
            table = [f"| {key} | {said(one)} | {said(two)} |" for key, (one, two) in single.items()]
            lines = [*head, "| | published | ours |", "|---|---|---|", *table, "", *lines]
        return lines
    return []


def page() -> str:
    """Return the page."""
    files = {name: FOLDER / f"{name}.json" for name in PAPERS}
    results = {name: json.loads(path.read_text("utf-8")) for name, path in files.items() if path.exists()}
    lines = ["| case | values compared | within 1 % | within 10 % | median difference |", "|---|---|---|---|---|"]
    for name, result in results.items():
        pairs = compared(result["published"], result["ours"])
        found = [off(one, two) for where, one, two in pairs if not is_time(where)]
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
