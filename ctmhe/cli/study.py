"""`ctmhe study run`, `status`, `resume`, `report`: studies from TOML files."""

from __future__ import annotations

import sys
import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ctmhe.errors import InputError, MissingExtra

if TYPE_CHECKING:
    from ctmhe.studies import Study, StudyResult

app = typer.Typer(help="Many runs over a grid and seeds: run, watch, go on, report.", no_args_is_help=True)
POINTS = 20
"""Points of a design that are printed."""
ERRORS = 3
"""Different errors that are printed."""

Folder = Annotated[Path, typer.Argument(help="The folder of a study.")]
Workers = Annotated[int | None, typer.Option(min=1, help="Processes; the file's, else 1.")]
Dask = Annotated[str | None, typer.Option(help="Address of a Dask scheduler to run on, such as tcp://host:8786.")]


@app.command()
def run(
    file: Annotated[Path, typer.Argument(help="The TOML file that describes the study.")],
    out: Annotated[Path | None, typer.Option(help="Folder for the results; results/NAME when left out.")] = None,
    workers: Workers = None,
    seeds: Annotated[int | None, typer.Option(min=1, help="Seeds 0 to N - 1, in place of the file's.")] = None,
    case: Annotated[
        str | None, typer.Option(help="A case of your own, file.py:function; the TOML then has [study] and [grid].")
    ] = None,
    dask: Dask = None,
) -> None:
    """Run a study; runs that its folder already has are not done again."""
    from ctmhe.studies.orders import begin

    study, number = begin(file, out, case=case, seeds=seeds, workers=workers)
    _perform(study, number, dask)


@app.command()
def resume(
    folder: Folder,
    workers: Workers = None,
    retry_failed: Annotated[bool, typer.Option("--retry-failed", help="Do failed runs again.")] = False,
    dask: Dask = None,
) -> None:
    """Go on with a study that was stopped."""
    from ctmhe.studies.orders import reopen

    study, number = reopen(folder)
    _perform(study, workers or number, dask, retry_failed)


@app.command()
def status(folder: Folder) -> None:
    """Print how far a study is; exit code 1 when runs failed."""
    from ctmhe.studies import StudyResult
    from ctmhe.studies import status as status_of

    found = status_of(folder)
    result = StudyResult.load(folder)
    typer.echo(f"{result.name}: {found}")
    if found.missing:
        if found.rate > 0:
            typer.echo(f"  at its last rate, {found.rate:.3g} runs a second, {_span(found.seconds_left)} more")
        typer.echo(f"  to go on: ctmhe study resume {folder}")
    elif found.total:
        typer.echo(f"  to see it: ctmhe study report {folder}")
    if found.failed:
        typer.echo(_failures(result))
        raise typer.Exit(1)


@app.command()
def report(
    folder: Folder,
    out: Annotated[
        Path | None, typer.Option(help="The page to write; report.html in the folder when left out.")
    ] = None,
    baseline: Annotated[
        str | None, typer.Option(help="What to compare with: parameter=label, or a label alone.")
    ] = None,
) -> None:
    """Write a study, finished or not, as one HTML page with its figures and tables."""
    from ctmhe.studies import StudyResult
    from ctmhe.studies.report import write_report

    result = StudyResult.load(folder)
    chosen = None if baseline is None else baseline_of(baseline, result)
    typer.echo(f"written: {write_report(result, out or folder / 'report.html', baseline=chosen)}")


def baseline_of(text: str, result: StudyResult) -> Any:
    """Return `parameter=label` as a mapping, numbers as numbers; other text is a label."""
    name, equals, label = text.partition("=")
    if not equals or name not in result.parameters:
        return text
    labels = {str(value): value for value in result.table[name].unique().tolist()}
    return {name: labels.get(label, label)}


def _perform(study: Study, workers: int, dask: str | None, retry_failed: bool = False) -> None:
    """Run a study, say how it went; exit code 1 when runs failed, 130 when stopped."""
    assert study.store is not None
    folder = study.store.folder
    before = study.status()
    where = f"on {dask}" if dask else f"{workers} worker{'s' * (workers > 1)}"
    typer.echo(f"{study!r}\n  folder: {folder}, {where}")
    if before.done:
        typer.echo(f"  {before.done} runs are there already")
    start = time.monotonic()
    executor = _client(dask) if dask else None
    try:
        bar = sys.stderr.isatty()
        result = study.run(workers=workers, executor=executor, progress=bar, retry_failed=retry_failed)
    except KeyboardInterrupt:
        found = study.status()
        typer.echo(f"\nstopped: {found}. Go on with\n  ctmhe study resume {folder}", err=True)
        raise typer.Exit(130) from None
    finally:
        if executor is not None:
            executor.close()
    done = len(result.table) - (before.done - before.failed * retry_failed)
    typer.echo(f"\n{done} run{'s' * (done != 1)} in {_span(time.monotonic() - start)}\n")
    typer.echo(_summary(result))
    typer.echo(f"\nwritten: {folder / 'table.parquet'}; for figures: ctmhe study report {folder}")
    if len(result.failed):
        typer.echo(f"\n{_failures(result)}", err=True)
        raise typer.Exit(1)


def _client(address: str) -> Any:
    try:
        from distributed import Client
    except ImportError:
        raise MissingExtra("distributed", "cluster", "--dask") from None
    try:
        return Client(address, timeout=20)
    except (OSError, ValueError) as error:
        raise InputError(f"no Dask scheduler answers at {address!r}: {error}") from None


def _summary(result: StudyResult) -> str:
    """Return means of the error and of what it cost, a line a point."""
    from ctmhe.plotting.style import title
    from ctmhe.plotting.tables import number
    from ctmhe.studies.figures import Roles

    roles = Roles.of(result)
    metrics = [name for name in (roles.error, roles.effort) if name is not None]
    if not metrics:
        return "no run left a number"
    found = [result.summary(name) for name in metrics]
    rows = [[*result.parameters, "runs", *(f"{title(name)} [95 %]" for name in metrics)]]
    for i in range(min(len(found[0]), POINTS)):
        row = [number(found[0][name].iloc[i]) for name in result.parameters]
        row.append(str(int(found[0]["n"].iloc[i])))
        for summary in found:
            mean, low, high = (float(summary[key].iloc[i]) for key in ("mean", "low", "high"))
            row.append(f"{mean:.4g}" + (f" [{low:.4g}, {high:.4g}]" if low < high else ""))
        rows.append(row)
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    lines.insert(1, "-" * max(map(len, lines)))
    if len(found[0]) > POINTS:
        lines.append(f"... {len(found[0]) - POINTS} more points")
    return "\n".join(lines)


def _failures(result: StudyResult) -> str:
    """Return how many runs failed, and the first of each different error."""
    failed = result.failed
    counts = Counter(failed["error"])
    lines = [f"{len(failed)} of {len(result.table)} runs failed:"]
    for error, count in list(counts.items())[:ERRORS]:
        first = failed[failed["error"] == error].iloc[0]
        point = ", ".join(f"{name} = {first[name]}" for name in (*result.parameters, "seed"))
        more = f" (and {count - 1} more)" if count > 1 else ""
        lines.append(f"  {point}{more}: {error}")
    if len(counts) > ERRORS:
        lines.append(f"  and {len(counts) - ERRORS} other errors; all are in the report")
    return "\n".join(lines)


def _span(seconds: float) -> str:
    """Return a duration for people."""
    if seconds < 120:
        return f"{seconds:.3g} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"
