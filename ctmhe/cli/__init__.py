"""The command line: `ctmhe demo`, `estimate`, `certify`, `fmu info`, `fmu build`, `study run`, `reproduce`."""

from __future__ import annotations

import json
import sys
import textwrap
from importlib.metadata import version as installed_version
from pathlib import Path
from typing import Annotated

import typer

from ctmhe.cli import study
from ctmhe.errors import CtmheError

app = typer.Typer(
    help="Continuous-time, event-triggered moving horizon estimation with FMU support.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
fmu_app = typer.Typer(help="Look into FMUs, and compile them.", no_args_is_help=True)
app.add_typer(fmu_app, name="fmu")
app.add_typer(study.app, name="study")


def _version(value: bool) -> None:
    if value:
        typer.echo(f"ctmhe {installed_version('ctmhe')}")
        raise typer.Exit()


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="Folder for the plot and the runs.")] = Path("demo"),
    seed: Annotated[int, typer.Option(help="Seed of disturbance and noise.")] = 0,
) -> None:
    """Estimate the reactor FMU under an event trigger, beside periodic sampling with as many samples."""
    from ctmhe.studies.demo import report, run_demo, write

    demonstration = run_demo(seed=seed)
    event = demonstration.event.dataset.attrs
    typer.echo(f"plant     {event['plant']} ({event['integrator']})")
    typer.echo(f"trigger   {event['trigger']}, channel {event['channel']}")
    typer.echo(f"estimator {event['estimator']}\n")
    typer.echo(report(demonstration))
    paths = write(demonstration, out)
    typer.echo("\nwritten: " + ", ".join(str(path) for path in paths))


@app.command()
def estimate(
    fmu: Annotated[Path, typer.Option(help="The FMU (model exchange).")],
    log: Annotated[Path, typer.Option(help="CSV file with the measurements.")],
    config: Annotated[Path, typer.Option(help="TOML file: tables model, log, estimator, guess, trigger, channel.")],
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("results"),
    trigger: Annotated[
        str | None, typer.Option(help="A policy of your own, file.py:Name, in place of the configuration's.")
    ] = None,
) -> None:
    """Estimate from a recorded log with an FMU as the model."""
    from ctmhe.studies.case import Case
    from ctmhe.studies.demo import save_plot
    from ctmhe.triggers.loading import load_trigger

    policy = load_trigger(trigger) if trigger else None
    case = Case.load(fmu=fmu, log=log, config=config, trigger=policy)
    run = case.run(progress=sys.stderr.isatty())
    typer.echo(repr(run))
    out.mkdir(parents=True, exist_ok=True)
    run.save(out / "run.nc")
    run.to_pandas().to_csv(out / "estimates.csv")
    run.events_to_pandas().to_csv(out / "events.csv")
    run.solves_to_pandas().to_csv(out / "solves.csv")
    save_plot(run, out / "estimates.png")
    typer.echo(f"\nwritten: {out / 'run.nc'}, estimates.csv, events.csv, solves.csv, estimates.png")


@app.command()
def certify(
    file: Annotated[Path, typer.Argument(help="TOML file: tables model, domain, certificate.")],
    json_file: Annotated[Path | None, typer.Option("--json", help="Write matrices and numbers as JSON.")] = None,
) -> None:
    """Certify that a model is detectable on a domain: rate, horizon, longest wait, and how far that is proved."""
    from ctmhe.studies.certify_file import as_json, certify_file, report

    found = certify_file(file)
    typer.echo(report(found))
    if json_file is not None:
        json_file.parent.mkdir(parents=True, exist_ok=True)
        json_file.write_text(json.dumps(as_json(found), indent=2) + "\n", encoding="utf-8")
        typer.echo(f"\nwritten: {json_file}")


@fmu_app.command("info")
def fmu_info(path: Annotated[Path, typer.Argument(help="The FMU.")]) -> None:
    """Print what an FMU is and what it offers."""
    from ctmhe.models.fmu import describe

    typer.echo(describe(path))


@fmu_app.command("check")
def fmu_check(paths: Annotated[list[Path], typer.Argument(help="FMUs.")]) -> None:
    """Try FMUs as plants and as models of an estimator; exit code 1 when one is unusable."""
    from ctmhe.simulation.fmu import check_fmu

    found = [check_fmu(path) for path in paths]
    typer.echo("\n\n".join(map(str, found)))
    if any(checkup.verdict == "unusable" for checkup in found):
        raise typer.Exit(1)


@fmu_app.command("build")
def fmu_build(
    path: Annotated[Path, typer.Argument(help="An FMU with C sources.")],
    out: Annotated[
        Path | None, typer.Option(help="The FMU to write; beside the given one, with the platform in its name.")
    ] = None,
) -> None:
    """Compile the C sources of an FMU for this platform, into a new FMU."""
    from ctmhe.models.fmu.building import build

    typer.echo(f"written: {build(path, out)}")


@app.command()
def reproduce(
    case: Annotated[
        str,
        typer.Argument(
            help="Name of a result, such as thesis-3.4.1-ct; `list` shows them, `all` runs those of the papers."
        ),
    ],
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the result as JSON; with `all`, a folder with a file a case.")
    ] = None,
    seeds: Annotated[int | None, typer.Option(help="Seeded runs; the case's own number if left out.", min=1)] = None,
    workers: Annotated[int, typer.Option(help="Processes for the runs of one case.", min=1)] = 1,
    jobs: Annotated[int, typer.Option(help="Cases at a time, with `all`.", min=1)] = 1,
) -> None:
    """Reproduce a published result and print it beside the published numbers."""
    from ctmhe.studies.reproduce import CASES, PAPERS
    from ctmhe.studies.reproduce import reproduce as run_case
    from ctmhe.studies.reproduce.together import together, write

    if case == "list":
        typer.echo("\n".join(CASES))
        return
    given = {} if seeds is None else {"seeds": seeds}
    if case == "all":
        failed = 0
        for number, done in enumerate(together(PAPERS, jobs=jobs, folder=json_file, options=given), start=1):
            said = f"{done.seconds:7.1f} s" if done.result is not None else f"failed: {done.error}"
            typer.echo(f"{number:3d}/{len(PAPERS)}  {done.name:<32s} {said}")
            failed += done.result is None
        if json_file is not None:
            typer.echo(f"written: {json_file}")
        if failed:
            raise typer.Exit(1)
        return
    result = run_case(case, **given, workers=workers, progress=sys.stderr.isatty())
    for part in ("published", "ours"):
        typer.echo(f"{part}:")
        typer.echo(textwrap.indent(json.dumps(result[part], indent=2), "  "))
    typer.echo(textwrap.fill(result["comment"], 100))
    if json_file is not None:
        write(result, json_file)
        typer.echo(f"written: {json_file}")


def main() -> None:
    """Run the command line; an error of this library is a readable text and exit code 1."""
    try:
        app()
    except CtmheError as error:
        lines = f"ctmhe: {error}".splitlines()  # a compiler's words keep their lines
        typer.echo("\n".join(textwrap.fill(line, 100, break_long_words=False) for line in lines), err=True)
        raise SystemExit(1) from None
