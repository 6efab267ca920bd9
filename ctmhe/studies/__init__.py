"""Studies: many runs and what they say; published results reproduced, and the demonstration."""

from ctmhe.studies.design import Design, from_table, full_grid, latin_hypercube, sobol
from ctmhe.studies.results import StudyResult
from ctmhe.studies.store import Status, status
from ctmhe.studies.study import Study

__all__ = ["Design", "Status", "Study", "StudyResult", "from_table", "full_grid", "latin_hypercube", "sobol", "status"]
