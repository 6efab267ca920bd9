"""A study as one self-contained HTML page: what was run, tables with intervals, figures, failures, how to go on."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from ctmhe.errors import InputError
from ctmhe.plotting.style import NAMES, title
from ctmhe.studies.figures import Picture, Roles, numeric, pictures, varied_in
from ctmhe.studies.results import StudyResult
from ctmhe.studies.store import replacing

SHOWN = ("online_rms", "retrospective_rms", "samples", "solves", "messages_lost", "longest_gap", "solve_ms_median")
ROWS = 200
"""Rows of a table; more are in `table.parquet`."""
CONFIDENCE = 0.95

STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, -apple-system, "Segoe UI", sans-serif; color: #1a1a1a; background: #fff;
       max-width: 62rem; margin: 0 auto; padding: 1rem 1.2rem 3rem; }
h1 { font-size: 1.6rem; margin: 0.6rem 0 0.2rem; } h2 { font-size: 1.2rem; margin: 2.2rem 0 0.6rem; }
p { margin: 0.4rem 0; } .note { color: #555; font-size: 0.9rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: 0.88rem; font-variant-numeric: tabular-nums; }
th, td { padding: 0.25rem 0.7rem; text-align: right; border-bottom: 1px solid #ddd; white-space: nowrap; }
th { border-bottom: 2px solid #888; font-weight: 600; vertical-align: bottom; }
.text { text-align: left; } td.long { white-space: pre-wrap; overflow-wrap: anywhere; min-width: 14rem; }
td { vertical-align: top; } td small { color: #555; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 0.2rem 1.2rem; margin: 0.4rem 0; }
dt { color: #555; } dd { margin: 0; overflow-wrap: anywhere; }
figure { margin: 1.2rem 0; break-inside: avoid; } figure img { width: 100%; max-width: 46rem; height: auto; }
figcaption { font-size: 0.9rem; color: #333; }
pre { background: #f5f5f5; padding: 0.7rem 0.9rem; overflow-x: auto; font-size: 0.85rem; }
.failed { color: #a33a00; font-weight: 600; }
@media (max-width: 40rem) { body { padding: 0.6rem; font-size: 15px; } dl { grid-template-columns: 1fr; gap: 0; }
  dd { margin-bottom: 0.5rem; } }
@media print { body { max-width: none; padding: 0; font-size: 10.5pt; } .wide { overflow: visible; }
  table { font-size: 8pt; } th, td { padding: 0.15rem 0.4rem; } pre { white-space: pre-wrap; } }
"""


def write_report(result: StudyResult | str | Path, path: str | Path, *, baseline: Any = None) -> Path:
    """Write a study's report.

    Parameters
    ----------
    result : StudyResult or path
        A result, or the folder of a study, finished or not.
    path : path
        The HTML file. It needs no other file and no network.
    baseline : mapping parameter -> label, or label, optional
        What points are compared with, see `StudyResult.compare`. When left out, the first label of the first parameter
        that has labels, everything else alike; the first point where all parameters are numbers.

    Returns
    -------
    Path

    Raises
    ------
    InputError
        For a folder without a study, and an unknown baseline.
    """
    if not isinstance(result, StudyResult):
        result = StudyResult.load(result)
    path = Path(path)
    page = make_page(result, baseline)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return path


def make_page(result: StudyResult, baseline: Any = None) -> str:
    """Return the report as HTML."""
    about = (result.store.read_about() if result.store else None) or {}
    name = escape(result.name)
    parts = [f"<h1>{name}</h1>", _headline(result, about), _what(result, about)]
    roles = Roles.of(result)
    if len(result.table) and len(result.failed) < len(result.table):
        differences, said = _differences(result, roles, baseline)
        shown = pictures(result, roles, differences)
        parts += ["<h2>Figures</h2>"] * bool(shown) + [_figure(picture) for picture in shown]
        parts += [_results(result), _compared(differences, said, roles, result)]
    parts += [_failures(result), _again(result)]
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{name}</title><style>{STYLE}</style></head>\n<body>\n" + "\n".join(parts) + "\n</body></html>\n"
    )


def _figure(picture: Picture) -> str:
    data, caption = b64encode(picture.svg).decode("ascii"), escape(picture.caption)
    image = f'<img alt="{caption}" src="data:image/svg+xml;base64,{data}">'
    return f"<figure>{image}<figcaption>{caption}</figcaption></figure>"


def _headline(result: StudyResult, about: Mapping[str, Any]) -> str:
    done, failed = len(result.table), len(result.failed)
    total = len(about.get("keys", ())) or done
    text = f"{done} runs" if done == total else f"{done} of {total} runs are finished"
    worse = f' <span class="failed">{failed} failed</span>.' if failed else ""
    return f"<p>{text}.{worse}</p>"


def _what(result: StudyResult, about: Mapping[str, Any]) -> str:
    table = result.table
    seeds = sorted(set(table["seed"].tolist()))
    rows = [(name, _listed(list(dict.fromkeys(table[name])))) for name in result.parameters]
    rows.append(("seeds", f"{len(seeds)}: {_listed(seeds)}; every point meets the same"))
    if about:
        rows += [("case", about["case"]), ("ctmhe", about["ctmhe"])]
        rows += [("version", about["version"])] if about.get("version") else []
    rows += _of_trajectories(result)
    if len(table):
        rows.append(("computing time", f"{table['seconds'].sum():.3g} s, all runs together"))
    items = "".join(f"<dt>{escape(str(key))}</dt><dd>{escape(str(value))}</dd>" for key, value in rows)
    return f"<h2>What was run</h2><dl>{items}</dl>"


def _of_trajectories(result: StudyResult) -> list[tuple[str, str]]:
    """Return how runs were made, as their trajectories tell; nothing where none were kept."""
    found: dict[str, list[str]] = {key: [] for key in ("plant", "integrator", "estimator", "channel", "location")}
    done = result.table[result.table["error"] == ""]
    first = done.groupby(list(result.parameters), sort=False).head(1) if result.parameters else done.head(1)
    for row in first.index[:20]:
        try:
            attributes = result.run(int(row)).dataset.attrs
        except InputError:
            return []
        for key, values in found.items():
            if key in attributes and str(attributes[key]) not in values:
                values.append(str(attributes[key]))
    titles = {"location": "times of events"}
    return [(titles.get(key, key), "; ".join(values)) for key, values in found.items() if values]


def _results(result: StudyResult) -> str:
    named = [name for name in SHOWN if name in result.metrics]
    own = [name for name in numeric(result) if name not in NAMES and "." not in name]
    shown = _telling(result, named + own)
    others = [name for name in numeric(result) if name not in shown]
    text = (
        f"<h2>Results</h2><p class='note'>Means over the seeds with {100 * CONFIDENCE:g} % confidence intervals of the "
        "mean (Student's t), over runs with a value (n).</p>" + _means(result, shown)
    )
    if others:
        text += f"<details><summary>{len(others)} other metrics</summary>{_means(result, others)}</details>"
    return text


def _telling(result: StudyResult, names: Sequence[str]) -> list[str]:
    """Return the metrics without those that are zero everywhere, or the same as one before."""
    kept: dict[str, Any] = {}
    for name in names:
        values = result.table[name].to_numpy(dtype=float)
        zero = name in ("messages_lost", "failed_solves") and not np.nan_to_num(values).any()
        if not zero and not any(np.array_equal(values, other, equal_nan=True) for other in kept.values()):
            kept[name] = values
    return list(kept)


def _means(result: StudyResult, metrics: Sequence[str]) -> str:
    if not metrics:
        return ""
    found = {name: result.summary(name, confidence=CONFIDENCE) for name in metrics}
    first = found[metrics[0]]
    header = [*result.parameters, "n", *(title(name) for name in metrics)]
    rows = []
    for i in range(min(len(first), ROWS)):
        counts = sorted({int(summary["n"].iloc[i]) for summary in found.values()})
        n = "-".join(str(count) for count in dict.fromkeys((counts[0], counts[-1])))
        cells = [_cell(first[name].iloc[i]) for name in result.parameters] + [f"<td>{n}</td>"]
        for summary in found.values():
            mean, low, high = (summary[key].iloc[i] for key in ("mean", "low", "high"))
            cells.append(f"<td>{_number(mean)}{_interval(low, high)}</td>")
        rows.append("".join(cells))
    return _table(header, rows, len(result.parameters), len(first))


def _differences(result: StudyResult, roles: Roles, baseline: Any) -> tuple[Any, str]:
    """Return the paired differences of the error, and the baseline in words; None where there is one point only."""
    if baseline is None:
        labelled = roles.texts[:1] or varied_in(result)
        baseline = {name: result.table[name].iloc[0] for name in labelled}
    if not baseline or roles.error is None:
        return None, ""
    said = ", ".join(f"{k} = {v}" for k, v in baseline.items()) if isinstance(baseline, Mapping) else str(baseline)
    return result.compare(roles.error, baseline, confidence=CONFIDENCE), said


def _compared(differences: Any, said: str, roles: Roles, result: StudyResult) -> str:
    if differences is None or not len(differences):
        return ""
    header = [*result.parameters, "pairs", "difference", "ratio", "pairs in which it is better"]
    rows = []
    for row in differences.head(ROWS).to_dict("records"):
        cells = [_cell(row[name]) for name in result.parameters]
        cells.append(f"<td>{row['n']}</td><td>{_number(row['difference'])}{_interval(row['low'], row['high'])}</td>")
        share = "" if np.isnan(row["better"]) else f"{100 * row['better']:.0f} %"
        cells.append(f"<td>{_number(row['ratio'])}</td><td>{share}</td>")
        rows.append("".join(cells))
    return (
        f"<h2>Compared with {escape(said)}</h2><p class='note'>{escape(title(str(roles.error)))}, minus that of the "
        "baseline under the same seed and otherwise the same parameters; negative is better.</p>"
        + _table(header, rows, len(result.parameters), len(differences))
    )


def _failures(result: StudyResult) -> str:
    failed = result.failed
    if not len(failed):
        return ""
    rows = []
    for row in failed.head(ROWS).to_dict("records"):
        cells = [_cell(row[name]) for name in (*result.parameters, "seed")]
        rows.append("".join(cells) + f'<td class="text long">{escape(str(row["error"]))}</td>')
    header = [*result.parameters, "seed", "error"]
    return "<h2>Failed runs</h2>" + _table(header, rows, len(header), len(failed))


def _again(result: StudyResult) -> str:
    """Return how the study is run again, with the file that describes it where there is one."""
    folder = result.store.folder if result.store else None
    if folder is None:
        return ""
    name = escape(folder.name)
    text = f"<h2>Again</h2><p>From the folder above <code>{name}</code>:</p><pre>"
    file = folder / "study.toml"
    if not file.is_file():
        return text + f"ctmhe study status {name}\nctmhe study report {name}</pre>"
    text += f"ctmhe study resume {name}      # what is missing\nctmhe study report {name}</pre>"
    content = escape(file.read_text(encoding="utf-8"))
    return text + f"<details><summary>study.toml</summary><pre>{content}</pre></details>"


def _table(header: Sequence[str], rows: Sequence[str], texts: int, total: int) -> str:
    heads = "".join(f"<th{' class=text' * (i < texts)}>{escape(str(name))}</th>" for i, name in enumerate(header))
    body = "\n".join(f"<tr>{row}</tr>" for row in rows)
    more = f"<p class='note'>The first {len(rows)} of {total} rows.</p>" if total > len(rows) else ""
    return f'<div class="wide"><table><thead><tr>{heads}</tr></thead>\n<tbody>{body}</tbody></table></div>{more}'


def _cell(value: Any) -> str:
    text = value if isinstance(value, str) else _number(value)
    return f'<td class="text">{escape(text)}</td>'


def _number(value: Any) -> str:
    if isinstance(value, (bool, np.bool_)):
        return str(bool(value))
    if value is None or np.isnan(value):
        return "n/a"
    if isinstance(value, (int, np.integer)) or (float(value).is_integer() and abs(value) < 1e6):
        return f"{int(value)}"
    return f"{value:.4g}"


def _interval(low: float, high: float) -> str:
    spread = np.isfinite(low) and low < high
    return f"<br><small>[{_number(low)}, {_number(high)}]</small>" if spread else ""


def _listed(values: Sequence[Any]) -> str:
    texts = [value if isinstance(value, str) else _number(value) for value in values]
    return ", ".join(texts) if len(texts) <= 12 else f"{', '.join(texts[:5])}, ..., {texts[-1]} ({len(texts)})"
