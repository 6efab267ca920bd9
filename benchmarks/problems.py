"""The benchmark problems, each defined once, as data and CasADi dynamics, whatever tool solves it.

Every problem is a receding window of N equal intervals of h seconds with one sample at the end of each. Update k
solves the window that ends at t = (N + k) h over x_0 .. x_N, the disturbances w_0 .. w_{N-1} and the parameters p::

    eta^T |(x_0, p) - prior_k|^2_P
      + sum_i c_i |w_i|^2_Q + sum_i eta^(T - (i+1) h) |h(x_{i+1}, u_i, w_i, p) - y_{k+i+1}|^2_R
    subject to x_{i+1} = F(x_i, w_i, p, u_i) and boxes on x, w, p

with c_i the integral of eta^(T - tau) over interval i and F a fixed number of RK4 steps or CVODES. The prior is
x_hat((k) h) of thesis (3.18); `benchmarks.reference` hands every tool the same one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from ctmhe.models import ContinuousModel
from ctmhe.models.library import batch_reactor, chua, quadrotor, van_der_pol
from ctmhe.models.library.cascaded_tanks import smooth_root
from ctmhe.models.library.quadrotor import ARM, GRAVITY, INERTIA, MASS, THRUST, TORQUE
from ctmhe.transcription import CVODES, RK4
from ctmhe.transcription.integrators import Integrator
from ctmhe.types import Array, Bounds, DiscountedCost

Box = tuple[Array, Array]


@dataclass(frozen=True, eq=False)
class Problem:
    """One estimation problem that recedes over a record.

    Attributes
    ----------
    name : str
    model : ContinuousModel
        Time-invariant.
    interval : float
        Seconds between samples; a shooting interval and a cell of w.
    count : int
        Intervals N of a window.
    steps : int
        RK4 steps an interval; 0 for CVODES.
    P, Q, R : array
        Weights of (x, p), of w per second and of a sample.
    eta : float
        Discount per second.
    x_guess, p_guess : array
        Estimate at t = 0.
    y : array (count + updates + 1, ny)
        Sample j at t = j interval; the first is not used.
    u : array (count + updates, nu)
        Input on interval j.
    x_box, w_box, p_box : (lower, upper)
    family : str
        Problems of one family differ in `size` only: the scaling exponents are fitted over them.
    size : int
    """

    name: str
    model: ContinuousModel
    interval: float
    count: int
    steps: int
    P: Array
    Q: Array
    R: Array
    eta: float
    x_guess: Array
    p_guess: Array
    y: Array
    u: Array
    x_box: Box
    w_box: Box
    p_box: Box
    family: str = ""
    size: int = 0
    cvodes: CVODES = field(default_factory=lambda: CVODES(1e-8, 1e-10))

    @property
    def updates(self) -> int:
        """How many times the window can move on."""
        return len(self.u) - self.count

    @property
    def horizon(self) -> float:
        """Length T of the window in seconds."""
        return self.count * self.interval

    @property
    def integrator(self) -> Integrator:
        """What carries the state, in the words of the library."""
        return RK4(step=self.interval / self.steps) if self.steps else self.cvodes

    @property
    def cost(self) -> DiscountedCost:
        """The same cost in the words of the library."""
        return DiscountedCost(P=self.P, Q=self.Q, R=self.R, R_point=self.R, eta=self.eta)

    @property
    def bounds(self) -> Bounds:
        """The same boxes in the words of the library."""
        return Bounds(x=self.x_box, w=self.w_box, p=self.p_box if len(self.model.p) else None)

    @cached_property
    def step(self) -> ca.Function:
        """F: (x, w, p, u) -> (x_next, y at the interval's end)."""
        return step_function(self.model, self.interval, self.steps, self.cvodes)

    def window(self, k: int) -> tuple[Array, Array]:
        """Return the samples (count, ny) and the inputs (count, nu) of update k."""
        return self.y[k + 1 : k + 1 + self.count], self.u[k : k + self.count]

    @cached_property
    def w_factors(self) -> Array:
        """c_i (count,): the integral of the discount over each interval."""
        rate, h = -np.log(self.eta), self.interval
        ends = self.horizon - h * np.arange(1, self.count + 1)
        length = h if rate == 0 else -np.expm1(-rate * h) / rate
        return np.exp(-rate * ends) * length

    @cached_property
    def y_factors(self) -> Array:
        """The discount of each sample (count,)."""
        return self.eta ** (self.horizon - self.interval * np.arange(1, self.count + 1))

    @property
    def prior_factor(self) -> float:
        """The discount of the prior."""
        return self.eta**self.horizon


def step_function(model: ContinuousModel, interval: float, steps: int, cvodes: CVODES) -> ca.Function:
    """Return (x, w, p, u) -> (x_next, y) over one interval: scalar expressions for RK4, an integrator for CVODES."""
    if not steps:
        kind: Any = ca.MX
        slot = cvodes.trace(model, False)
    else:
        kind, slot = ca.SX, None
    x, w, p, u = (kind.sym(key, len(getattr(model, key))) for key in "xwpu")
    if slot is not None:
        x_next, y = slot(0.0, interval, x, w, p, u, u)
        return ca.Function("step", [x, w, p, u], [x_next, y])
    state, h = x, interval / steps
    for _ in range(steps):
        k1 = model.dynamics(0, state, u, w, p)
        k2 = model.dynamics(0, state + h / 2 * k1, u, w, p)
        k3 = model.dynamics(0, state + h / 2 * k2, u, w, p)
        k4 = model.dynamics(0, state + h * k3, u, w, p)
        state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return ca.Function("step", [x, w, p, u], [state, model.output(0, state, u, w, p)])


def record(
    step: ca.Function, x: Any, p: Any, u: Array | Callable[[int, Array], Array], length: int, noise: Any, w_size: Any
) -> tuple[Array, Array]:
    """Simulate F with random disturbances; return samples (length + 1, ny) with noise, and the inputs."""
    rng = np.random.default_rng(20240817)
    nw, ny = step.size1_in(1), step.size1_out(1)
    x, rows, inputs = np.asarray(x, float), [np.zeros(ny)], []
    for j in range(length):
        value = u(j, x) if callable(u) else u[j]
        after, y = step(x, w_size * rng.normal(size=nw), p, value)
        x = np.asarray(after).reshape(-1)
        rows.append(np.asarray(y).reshape(-1) + noise * rng.normal(size=ny))
        inputs.append(value)
    return np.array(rows), np.array(inputs).reshape(length, -1)


def free(n: int) -> Box:
    """Return a box without sides."""
    return np.full(n, -np.inf), np.full(n, np.inf)


def box_of(model: ContinuousModel, **sides: tuple[float, float]) -> Box:
    """Return the state box with the named sides."""
    lower, upper = free(len(model.x))
    for name, (low, high) in sides.items():
        i = model.x.index(name)
        lower[i], upper[i] = low, high
    return lower, upper


def reactor(name: str, updates: int, *, count: int = 200, steps: int = 1, upper_b: float = 5.0) -> Problem:
    """Thesis 3.4.1 over T = 2 s: 200 intervals of 0.01 s, or 20 with ten RK4 steps each."""
    model, h = batch_reactor(noise=False), 2.0 / count
    step = step_function(model, h, steps, CVODES())
    y, u = record(step, [3.0, 1.0], [], np.empty((count + updates, 0)), count + updates, 0.05, 0.02)
    P = 2 * np.array([[4.009, 3.768], [3.768, 3.549]])
    box = box_of(model, pA=(0.1, 5.0), pB=(0.1, upper_b))
    return Problem(
        name, model, h, count, steps, P, 2e3 * np.eye(2), 1e2 * h * np.eye(1), 0.4,
        np.array([2.5, 1.3]), np.empty(0), y, u, box, free(2), free(0),
    )  # fmt: skip


def copter(name: str, updates: int, *, count: int = 30, tight: bool = False) -> Problem:
    """The quadrotor swaying under a controller that knows its state, in intervals of 0.05 s."""
    model, h = quadrotor(noise=False), 0.05
    step = step_function(model, h, 1, CVODES())
    mix = np.array([[THRUST] * 4, [0, -ARM * THRUST, 0, ARM * THRUST], [ARM * THRUST, 0, -ARM * THRUST, 0],
                    [-TORQUE, TORQUE, -TORQUE, TORQUE]])  # fmt: skip

    def rotors(j: int, x: Array) -> Array:
        phase = 2 * np.pi * j * h / 1.5
        target = 0.22 * np.array([np.sin(phase), np.cos(phase), 0.0])
        torque = np.array(INERTIA) * (60 * (target - x[3:6]) - 12 * x[9:12])
        return np.sqrt(np.clip(np.linalg.solve(mix, [MASS * GRAVITY, *torque]), 0.0, 1500.0**2))

    start = np.zeros(12)
    start[6:9] = [0.3, -0.2, 0.1]
    y, u = record(step, start, [], rotors, count + updates, 0.02, 0.3)
    if tight:
        box = box_of(model, phi=(-0.2, 0.2), theta=(-0.2, 0.2), s1=(-0.7, 0.7))
    else:
        sides = dict.fromkeys(("phi", "theta", "psi"), (-np.pi / 6, np.pi / 6)) | dict.fromkeys(
            ("O1", "O2", "O3"), (-1.15, 1.15)
        )
        box = box_of(model, **sides)
    return Problem(
        name, model, h, count, 1, 10 * np.eye(12), 10 * np.eye(12), 2.5e3 * np.eye(6), 0.92,
        start, np.empty(0), y, u, box, free(12), free(0),
    )  # fmt: skip


def circuit(name: str, updates: int, *, count: int = 150, family: str = "") -> Problem:
    """The Chua circuit with its cubic coefficient unknown, in intervals of 0.02 s."""
    model, h = chua(noise=False), 0.02
    step = step_function(model, h, 1, CVODES())
    y, u = record(step, [1.0, 0.0, -1.0], [0.45], np.empty((count + updates, 0)), count + updates, 0.05, 0.1)
    lower, upper = box_of(model, x1=(-4.0, 4.0), x2=(-2.0, 2.0), x3=(-6.0, 6.0))
    return Problem(
        name, model, h, count, 1, np.diag([10.0, 10.0, 10.0, 100.0]), 1e2 * np.eye(3), 4e2 * np.eye(1), 0.98,
        np.array([0.9, 0.1, -0.9]), np.array([0.4]), y, u, (lower, upper), free(3),
        (np.array([0.2]), np.array([0.8])), family, count,
    )  # fmt: skip


def oscillator(name: str, updates: int, *, count: int = 30) -> Problem:
    """The van der Pol oscillator with mu = 10, integrated by CVODES inside the problem."""
    model, h = van_der_pol(mu=10.0, noise=False), 0.2
    cvodes = CVODES(1e-8, 1e-10)
    step = step_function(model, h, 0, cvodes)
    y, u = record(step, [2.0, 0.0], [], np.empty((count + updates, 0)), count + updates, 0.02, 0.01)
    return Problem(
        name, model, h, count, 0, np.diag([10.0, 1.0]), 1e4 * np.eye(2), 2.5e3 * np.eye(1), 0.98,
        np.array([1.95, 0.0]), np.empty(0), y, u, free(2), free(2), free(0), cvodes=cvodes,
    )  # fmt: skip


def chain(name: str, updates: int, *, tanks: int = 40, count: int = 20, family: str = "") -> Problem:
    """Tanks in a row, each draining into the next; every fourth level is measured."""
    names, h = [f"level{i}" for i in range(tanks)], 1.0
    seen = list(range(0, tanks, 4))

    def f(t: Any, x: Any, u: Any, w: Any, p: Any) -> Any:
        flow = 0.5 * ca.vertcat(u[0], *(smooth_root(x[i]) for i in range(tanks)))
        return flow[:-1] - flow[1:] + w

    model = ContinuousModel(
        f, lambda t, x, u, w, p: x[seen], x=names, u="pump", w=[f"w_{name}" for name in names],
        y=[names[i] for i in seen], name="tanks", bounds=Bounds(x=(0.05, 4.0)),
    )  # fmt: skip
    step = step_function(model, h, 1, CVODES())
    pump = 1.0 + 0.3 * np.sign(np.sin(2 * np.pi * np.arange(count + updates) / 25))
    y, u = record(step, np.ones(tanks), [], pump[:, None], count + updates, 0.02, 0.02)
    return Problem(
        name, model, h, count, 1, 10 * np.eye(tanks), 1e3 * np.eye(tanks), 2.5e3 * np.eye(len(seen)), 0.98,
        np.full(tanks, 1.05), np.empty(0), y, u, (np.full(tanks, 0.05), np.full(tanks, 4.0)), free(tanks), free(0),
        family, tanks,
    )  # fmt: skip


PROBLEMS: dict[str, Callable[[int], Problem]] = {
    "P1a": lambda updates: reactor("P1a", updates),
    "P1b": lambda updates: reactor("P1b", updates, count=20, steps=10),
    "P1c": lambda updates: reactor("P1c", updates, upper_b=1.9),
    "P2": lambda updates: copter("P2", updates),
    "P2c": lambda updates: copter("P2c", updates, tight=True),
    "P3": lambda updates: circuit("P3", updates),
    "vdp": lambda updates: oscillator("vdp", updates),
    "tanks40": lambda updates: chain("tanks40", updates),
}

SIZES = {"N": (50, 200, 500, 1000, 2000, 5000), "nx": (4, 8, 16, 32)}
SCALING: dict[str, Callable[[int], Problem]] = {
    **{f"chua-N{n}": (lambda updates, n=n: circuit(f"chua-N{n}", updates, count=n, family="N")) for n in SIZES["N"]},
    **{f"tanks{n}": (lambda updates, n=n: chain(f"tanks{n}", updates, tanks=n, family="nx")) for n in SIZES["nx"]},
}
