"""Published results, one file each; every case returns `published`, `ours`, `settings` and `comment`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ctmhe.errors import InputError
from ctmhe.studies.reproduce import (
    certified_runs,
    paper_000_5,
    study_reactor_budget,
    study_solves_saved,
    thesis_3_4_1_certificate,
    thesis_3_4_1_ct,
    thesis_3_4_2_certificate,
    thesis_4_3_3_horizons,
    thesis_5_2_4,
    thesis_5_2_4_horizon,
    thesis_5_3_3,
    thesis_printed_certificates,
    thesis_table_3_2,
    thesis_table_4_2,
)

CASES: dict[str, Callable[..., dict[str, Any]]] = {
    "thesis-3.4.1-ct": thesis_3_4_1_ct.reproduce,
    "thesis-3.4.1-certificate": thesis_3_4_1_certificate.reproduce,
    "thesis-table-3.2": thesis_table_3_2.reproduce,
    "thesis-table-4.2": thesis_table_4_2.reproduce,
    "thesis-4.3.3-horizons": thesis_4_3_3_horizons.reproduce,
    "thesis-5.2.4-horizon": thesis_5_2_4_horizon.reproduce,
    "thesis-5.2.4": thesis_5_2_4.reproduce,
    "thesis-5.3.3": thesis_5_3_3.reproduce,
    "paper000-5": paper_000_5.reproduce,
    "certified-runs": certified_runs.reproduce,
    "thesis-3.4.2-certificate": thesis_3_4_2_certificate.reproduce,
    "thesis-printed-certificates": thesis_printed_certificates.reproduce,
    "study-reactor-budget": study_reactor_budget.reproduce,
    "study-solves-saved": study_solves_saved.reproduce,
}

PAPERS = tuple(name for name in CASES if name.startswith(("thesis", "paper")))
"""What papers print; the other cases are questions of our own."""


def reproduce(case: str, **options: Any) -> dict[str, Any]:
    """Run a case by name; keywords such as `seeds=` go to it.

    Raises
    ------
    InputError
        For an unknown case.
    """
    if case not in CASES:
        raise InputError(f"unknown case {case!r}. Known: {', '.join(CASES)}")
    return CASES[case](**options)
