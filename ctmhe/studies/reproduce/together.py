"""All published results in one go: cases side by side in processes of their own, one file each."""

from __future__ import annotations

import json
import multiprocessing
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ctmhe.errors import InputError

DIGITS = 6


@dataclass(frozen=True, eq=False)
class Finished:
    """One case that ended.

    Attributes
    ----------
    name : str
    seconds : float
    result : dict or None
    error : str
        Why there is none.
    """

    name: str
    seconds: float
    result: dict[str, Any] | None
    error: str = ""


def together(
    names: Sequence[str], *, jobs: int = 1, folder: Path | None = None, options: dict[str, Any] | None = None
) -> Iterator[Finished]:
    """Run cases by name, `jobs` at a time, and hand out each as it ends; a case that fails stops no other.

    Parameters
    ----------
    names : sequence of str
    jobs : int
        Processes; every case has a fresh one.
    folder : Path, optional
        Where each result is written when it is there, as NAME.json.
    options : dict, optional
        Keywords for every case, such as `seeds`.
    """
    if jobs < 1:
        raise InputError(f"jobs must be at least 1, got {jobs}")
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, mp_context=context, max_tasks_per_child=1) as pool:
        waiting = {pool.submit(_timed, name, options or {}): name for name in names}
        for future in as_completed(waiting):
            try:
                finished = future.result()
            except Exception as error:  # whatever a case raises, or a process that died: the others go on
                finished = Finished(waiting[future], float("nan"), None, f"{type(error).__name__}: {error}")
            if folder is not None and finished.result is not None:
                write(finished.result, folder / f"{finished.name}.json")
            yield finished


def _timed(name: str, options: dict[str, Any]) -> Finished:
    from ctmhe.studies.reproduce import reproduce

    began = time.perf_counter()
    result = reproduce(name, **options)
    return Finished(name, time.perf_counter() - began, result)


def write(result: dict[str, Any], path: Path) -> None:
    """Write a result as JSON, numbers to six digits."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    part.write_text(json.dumps(_rounded(result), indent=2) + "\n", encoding="utf-8")
    part.replace(path)


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _rounded(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_rounded(inner) for inner in value]
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value
