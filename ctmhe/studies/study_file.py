"""A study from a TOML file: what `DescribedCase` needs, or a case from a Python file, and a grid over it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ctmhe.errors import InputError, MissingExtra
from ctmhe.studies.described import LIBRARY, PLANTS, DescribedCase, build, build_disturbance, changed
from ctmhe.studies.design import Design, full_grid, latin_hypercube, sobol
from ctmhe.studies.study import Study
from ctmhe.studies.tables import (
    ESTIMATOR,
    MODEL,
    build_channel,
    build_guess,
    check_keys,
    choose,
    read_toml,
    table_of,
)
from ctmhe.triggers.loading import build_trigger, execute_file

ABOUT = ("name", "seeds", "design", "points", "design_seed", "workers", "trajectories", "metrics")
"""Keys of [study] that describe the study; the others are the case's."""
RUNNING = ("until", "start", "monitor", "locate")
EITHER = ("truth", "parameters", "inputs")
PLANT = {
    "model": (*LIBRARY, *EITHER),
    "fmu": ("fmu", *EITHER, "outputs", "states", "disturbances", "kind", "step", "rtol", "atol", "isolated"),
}
TABLES = ("study", "plant", "disturbance", "model", "estimator", "guess", "trigger", "channel")
DESIGNS: dict[str, Callable[..., Design]] = {"latin-hypercube": latin_hypercube, "sobol": sobol}


@dataclass(frozen=True, eq=False)
class Description:
    """A study as a file describes it.

    Attributes
    ----------
    case : callable (*, seed, **point)
    design : Design
    name : str
    seeds : int or list of int
    workers : int
    trajectories : bool
    metrics : list of str, optional
    """

    case: Callable[..., Any]
    design: Design
    name: str
    seeds: Any = 20
    workers: int = 1
    trajectories: bool = False
    metrics: Any = None

    def study(self, folder: Path | None = None, *, seeds: int | None = None) -> Study:
        """Return the study, kept in `folder`; `seeds` in place of the file's."""
        return Study(
            self.case,
            self.design,
            self.seeds if seeds is None else seeds,
            folder=folder,
            name=self.name,
            metrics=self.metrics,
            trajectories=self.trajectories,
        )


def load_study(path: Path, *, case: str | None = None, directory: Path | None = None) -> Description:
    """Read a study.

    Parameters
    ----------
    path : Path
        The TOML file.
    case : str, optional
        `file.py:function`, a case of one's own that takes seed and the grid's keys; the file then holds [study] and
        [grid] only. The Python file is executed.
    directory : Path, optional
        Where paths in the file start; its own folder when left out.

    Raises
    ------
    InputError
        For what cannot be read, unknown keys (with the nearest known one), missing and wrong values; file, table and
        key are named.
    """
    path, where = Path(path), str(path)
    directory = Path(directory or path.parent).absolute()
    content = read_toml(path)
    about, grid = table_of(content, "study", where), table_of(content, "grid", where)
    if case is not None:
        check_keys(content, ("study", "grid"), f"{where}, with --case")
        check_keys(about, ABOUT, f"{where}: table [study], with --case")
        function = load_case(case)
    else:
        check_keys(content, (*TABLES, "grid"), where)
        check_keys(about, (*ABOUT, *RUNNING), f"{where}: table [study]")
        function = DescribedCase(_tables(content, about, directory, where))
        _check(function.tables, where)
        for name, label, value in _values(grid, where):
            _check(changed(function.tables, {name: value}, where), f"{where}: [grid] {name} = {label}", trial=False)
    known = {key: about[key] for key in ("seeds", "workers", "trajectories", "metrics") if key in about}
    return Description(function, _design(about, grid, where), str(about.get("name", path.stem)), **known)


def load_case(location: str) -> Callable[..., Any]:
    """Return the function `file.py:function`; the file is executed, here only: workers are sent what it made."""
    try:
        import cloudpickle
    except ImportError:
        raise MissingExtra("cloudpickle", "study", "a case from a file") from None
    module, name = execute_file(location, "case")
    function = getattr(module, name, None)
    if not callable(function):
        found = [key for key, value in vars(module).items() if callable(value) and value.__module__ == module.__name__]
        raise InputError(f"case {location!r}: no function {name!r} in it. There: {', '.join(found) or 'none'}")
    cloudpickle.register_pickle_by_value(module)
    return function


def _tables(content: Mapping[str, Any], about: Mapping[str, Any], directory: Path, where: str) -> dict[str, Any]:
    """Return the tables of the case, with absolute paths and the model that stands for the plant."""
    tables = {name: table_of(content, name, where) for name in TABLES if name != "trigger"}
    tables["study"] = {key: about[key] for key in RUNNING if key in about}
    if "trigger" not in content:
        raise InputError(f"{where}: a study needs a table [trigger], such as trigger = {{name = 'Periodic', ...}}")
    tables["trigger"] = content["trigger"]
    plant, model = tables["plant"], tables["model"]
    if ("model" in plant) == ("fmu" in plant):
        raise InputError(
            f"{where}: table [plant] needs model (one of {', '.join(PLANTS)}) or fmu (a path), and not both"
        )
    if "model" not in model and "fmu" not in model:
        if "fmu" in plant:
            model["fmu"] = plant["fmu"]
        else:  # noise is then what the estimator's residual stands for
            tables["model"] = {"model": plant["model"], "options": {"noise": False} | plant.get("options", {})} | model
    for name in ("plant", "model"):
        if "fmu" in tables[name]:
            tables[name]["fmu"] = str(directory / str(tables[name]["fmu"]))
    return tables


def _check(tables: Mapping[str, Any], where: str, trial: bool = True) -> None:
    """Raise for what can be known to be wrong before anything runs; `trial`: build plant and estimator too."""
    if "until" not in tables["study"]:
        raise InputError(f"{where}: table [study] needs until (seconds)")
    check_keys(tables, TABLES, where)
    check_keys(tables["study"], RUNNING, f"{where}: table [study]")
    check_keys(tables["plant"], PLANT["fmu" if "fmu" in tables["plant"] else "model"], f"{where}: table [plant]")
    known = ("fmu", *MODEL) if "fmu" in tables["model"] else LIBRARY
    check_keys(tables["model"], known, f"{where}: table [model]")
    check_keys(tables["estimator"], ESTIMATOR, f"{where}: table [estimator]")
    try:
        build_trigger(tables["trigger"])
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    build_channel(tables["channel"], where)
    build_disturbance(tables["disturbance"], where)
    if trial:
        plant, mhe = build(tables)
        build_guess(tables["guess"], mhe.model, where)
        check_keys(tables["disturbance"], plant.w.names, f"{where}: table [disturbance]")


def _design(about: Mapping[str, Any], grid: Mapping[str, Any], where: str) -> Design:
    """Return the design: ranges `{low, high, log}` are sampled, lists and labelled values make the grid."""
    ranges = {name: value for name, value in grid.items() if _is_range(value)}
    rest = {name: value for name, value in grid.items() if name not in ranges}
    kind = choose({"grid": None, **DESIGNS}, about.get("design", "grid"), f"{where}: table [study]: design") or "grid"
    points = about.get("points")
    if kind == "grid":
        if ranges or points is not None:
            what = f"[grid] {next(iter(ranges))} is a range" if ranges else "points are given"
            raise InputError(f'{where}: {what}; table [study] then needs design = "latin-hypercube" or "sobol"')
        return full_grid(rest)
    if not ranges or points is None:
        missing = "points in [study]" if ranges else "ranges {low = ..., high = ..., log = true} in [grid]"
        raise InputError(f"{where}: design = {about['design']!r} needs {missing}")
    space = {name: (value["low"], value["high"]) for name, value in ranges.items()}
    log = [name for name, value in ranges.items() if value.get("log", False)]
    return full_grid(rest) * kind(space, points, about.get("design_seed", 0), log=log)


def _values(grid: Mapping[str, Any], where: str) -> Iterator[tuple[str, str, Any]]:
    """Yield (key, label, value) for each value in the grid, both ends of ranges."""
    for name, given in grid.items():
        if name.split(".")[0] not in TABLES:
            check_keys([name.split(".")[0]], TABLES, f"{where}: table [grid]")
        if _is_range(given):
            pairs = [(str(given[end]), given[end]) for end in ("low", "high")]
        elif isinstance(given, Mapping):
            pairs = list(given.items())
        elif isinstance(given, list):
            pairs = [(repr(value), value) for value in given]
        else:
            raise InputError(
                f"{where}: [grid] {name}: expected a list of values, labels with values, or low and high, got {given!r}"
            )
        for label, value in pairs:
            if (
                "." not in name
                and not isinstance(value, Mapping)
                and not (name == "trigger" and isinstance(value, str))
            ):
                raise InputError(
                    f"{where}: [grid] {name}.{label} = {value!r} is not a table to take the place of [{name}]; to vary "
                    f'one key, put it in quotes: "{name}.{label}" = [...]'
                )
            yield name, label, value


def _is_range(value: Any) -> bool:
    return isinstance(value, Mapping) and {"low", "high"} <= set(value) <= {"low", "high", "log"}
