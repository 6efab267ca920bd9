"""What the folder of a study keeps so that the command line can go on with it: the TOML file and how it was called."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from ctmhe.errors import InputError
from ctmhe.studies.store import replacing
from ctmhe.studies.study import Study
from ctmhe.studies.study_file import load_study

FILE, ORDER = "study.toml", "order.json"


@dataclass(frozen=True)
class Order:
    """How a study was called.

    Attributes
    ----------
    name : str
        Of the study.
    directory : str
        Folder of the TOML file, where paths in it start.
    case : str or None
        `file.py:function`, with an absolute path.
    seeds : int or None
        In place of the file's.
    workers : int or None
        In place of the file's.
    """

    name: str
    directory: str
    case: str | None = None
    seeds: int | None = None
    workers: int | None = None


def begin(
    path: Path, folder: Path | None, *, case: str | None = None, seeds: int | None = None, workers: int | None = None
) -> tuple[Study, int]:
    """Return the study that a TOML file describes and its number of workers; what `resume` needs is in its folder.

    Parameters
    ----------
    path : Path
        The TOML file.
    folder : Path, optional
        `results/<name>` when left out.
    case : str, optional
        `file.py:function`, see `load_study`.
    seeds, workers : int, optional
        In place of the file's.

    Raises
    ------
    InputError
        As `load_study`, and when the folder holds another study.
    """
    description = load_study(path, case=case)
    folder = folder or Path("results") / description.name
    study = description.study(folder, seeds=seeds)
    if case is not None:
        file, _, function = case.rpartition(":")
        case = f"{Path(file).absolute()}:{function}"
    order = Order(description.name, str(Path(path).parent.absolute()), case, seeds, workers)
    folder.mkdir(parents=True, exist_ok=True)
    with replacing(folder / FILE) as temporary:
        temporary.write_bytes(Path(path).read_bytes())
    with replacing(folder / ORDER) as temporary:
        temporary.write_text(json.dumps(asdict(order), indent=1) + "\n", encoding="utf-8")
    return study, workers or description.workers


def reopen(folder: Path) -> tuple[Study, int]:
    """Return the study in a folder and its number of workers.

    Raises
    ------
    InputError
        When the folder was not made by `ctmhe study run`, or its case has moved.
    """
    folder = Path(folder)
    try:
        order = Order(**json.loads((folder / ORDER).read_text(encoding="utf-8")))
    except FileNotFoundError:
        if (folder / "study.json").is_file():
            text = "was not started by `ctmhe study run`: run the program that started it again, it goes on"
        else:
            text = "holds no study"
        raise InputError(f"study: {str(folder)!r} {text}") from None
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"study: {folder / ORDER} cannot be read: {error}") from None
    description = load_study(folder / FILE, case=order.case, directory=Path(order.directory))
    study = replace(description, name=order.name).study(folder, seeds=order.seeds)
    return study, order.workers or description.workers
