"""Studies: many runs and what they say; published results reproduced, and the demonstration."""

from ctmhe.studies.design import Design, from_table, full_grid, latin_hypercube, sobol
from ctmhe.studies.exploration import Exploration, explore
from ctmhe.studies.results import StudyResult
from ctmhe.studies.store import Status, status
from ctmhe.studies.study import Study
from ctmhe.studies.tuning import Threshold, find_threshold, pareto_front

__all__ = [
    "Design",
    "Exploration",
    "Status",
    "Study",
    "StudyResult",
    "Threshold",
    "explore",
    "find_threshold",
    "from_table",
    "full_grid",
    "latin_hypercube",
    "pareto_front",
    "sobol",
    "status",
]
