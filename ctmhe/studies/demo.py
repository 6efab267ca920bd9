"""The main job in small: an FMU plant, an event trigger, estimates beside periodic sampling with as many samples."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ctmhe.estimators.mhe import MHE
from ctmhe.models.fmu import FmuModel
from ctmhe.simulation import FmuPlant, Run, Uniform, WholeSignal, simulate
from ctmhe.studies.reproduce.thesis_3_4_1_ct import ETA, GUESS, P, Q, R
from ctmhe.transcription import RK4
from ctmhe.triggers import MaxInterval, Periodic, SendOnDelta, Trigger
from ctmhe.types import Bounds, DiscountedCost

UNTIL = 5.0
DISTURBANCE = {"w_pA": Uniform(0.05, interval=0.1), "w_pB": Uniform(0.05, interval=0.1)}
NOISE = {"v_pressure": Uniform(0.01, interval=0.01)}


@dataclass(frozen=True, eq=False)
class Demonstration:
    """What the demonstration computed: the event-triggered run and its honest rival."""

    event: Run
    periodic: Run


def run_demo(*, seed: int = 0, trigger: Trigger | None = None) -> Demonstration:
    """Build the reactor FMU, run it as plant, estimate its two partial pressures from the total pressure.

    Parameters
    ----------
    seed : int
        Of disturbance and noise; both runs meet the same.
    trigger : Trigger, optional
        `SendOnDelta(0.08) | MaxInterval(0.5)` when left out.

    Returns
    -------
    Demonstration
    """
    from fmus.build import build

    path = build("batch_reactor", fmi=2)
    model = FmuModel(path, inputs=[])
    mhe = MHE(
        model,
        horizon=2.0,
        interval=0.1,
        integrator=RK4(step=0.02),
        cost=DiscountedCost(eta=ETA, P=2 * P, Q=2 * Q[:2, :2], R=R),
        bounds=Bounds(x=(0.1, 5.0)),
    )

    def one(policy: Trigger) -> Run:
        return simulate(
            FmuPlant(path, inputs=[]),
            mhe,
            trigger=policy,
            until=UNTIL,
            guess=GUESS,
            channel=WholeSignal(every=0.01),
            disturbance=DISTURBANCE | NOISE,
            monitor=0.01,
            seed=seed,
        )

    event = one(trigger or SendOnDelta(0.08) | MaxInterval(0.5))
    period = UNTIL / max(event.samples, 1)
    return Demonstration(event, one(Periodic(period, start=period)))


def report(demonstration: Demonstration) -> str:
    """Return the demonstration's numbers as a table."""
    event, periodic = demonstration.event, demonstration.periodic
    rows = [
        ("", "event-triggered", "periodic"),
        ("samples", f"{event.samples}", f"{periodic.samples}"),
        ("solves", f"{event.solves}", f"{periodic.solves}"),
        (
            "shortest / longest gap [s]",
            *(f"{run.gaps[1:].min():.3f} / {run.gaps.max():.3f}" for run in (event, periodic)),
        ),
        ("online RMS error [bar]", f"{event.online_rms():.4f}", f"{periodic.online_rms():.4f}"),
        ("  of it after 1 s", f"{event.online_rms(since=1.0):.4f}", f"{periodic.online_rms(since=1.0):.4f}"),
        ("retrospective RMS error [bar]", f"{event.retrospective_rms():.4f}", f"{periodic.retrospective_rms():.4f}"),
        ("median solve [ms]", *(f"{1e3 * median(run):.1f}" for run in (event, periodic))),
    ]
    widths = [max(len(row[i]) for row in rows) for i in range(3)]
    lines = [f"{a:<{widths[0]}}  {b:>{widths[1]}}  {c:>{widths[2]}}" for a, b, c in rows]
    lines.insert(1, "-" * len(lines[0]))
    return "\n".join(lines)


def median(run: Run) -> float:
    """Return the median solve time in seconds."""
    ordered = sorted(float(s) for s in run.solve_seconds)
    return ordered[len(ordered) // 2] if ordered else float("nan")


def write(demonstration: Demonstration, folder: str | Path) -> list[Path]:
    """Write `run.nc`, `periodic.nc` and `estimates.png` into `folder`; return their paths."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    paths = [demonstration.event.save(folder / "run.nc"), demonstration.periodic.save(folder / "periodic.nc")]
    paths.append(save_plot(demonstration.event, folder / "estimates.png"))
    return paths


def save_plot(run: Run, path: Path) -> Path:
    """Draw a run into a PNG file."""
    axes = run.plot()
    figure = axes[0].figure
    figure.savefig(path, dpi=150)
    return path
