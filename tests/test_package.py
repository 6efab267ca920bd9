"""What holds for the package as a whole."""

from __future__ import annotations

import subprocess
import sys

HEAVY = ["fmpy", "matplotlib", "cvxpy", "scikits_odes_sundials", "joblib", "zarr", "xarray", "pandas", "h5netcdf"]
HEAVY += ["typer", "tqdm", "scipy.linalg", "scipy.optimize"]


def test_importing_ctmhe_loads_no_heavy_library():
    """Optional and heavy libraries are imported where they are used, so that `import ctmhe` costs what casadi costs."""
    code = f"import sys, ctmhe; print(*[name for name in {HEAVY!r} if name in sys.modules])"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not loaded, f"import ctmhe loads {', '.join(loaded)}"
