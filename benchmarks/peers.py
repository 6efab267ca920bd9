"""The tools, each behind the same call: ctmhe, CasADi's solvers as an expert would set them up, do-mpc."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import casadi as ca
import numpy as np

from benchmarks.problems import Problem
from benchmarks.reference import Reference, accepts, build, grow, observe
from ctmhe.types import Array, Outcome

CONVERGED, ONE = "converged", "one-iteration"
AGREEMENT = 1e-6  # relative: costs that differ by less are the same
PROBE = 25  # windows on which a method's tolerance is chosen


class Unavailable(Exception):
    """This tool cannot run here or cannot take this problem; the message says why."""


class Update(NamedTuple):
    """What a tool made of one window: its cost, the state at the end, its own word on convergence."""

    cost: float
    x_end: Array
    converged: bool
    iterations: int


class Tool(Protocol):
    """One way to solve a problem's windows one after the other.

    `update(k)` solves window k from what was kept of window k - 1, and gives the same result when called again: only
    the first call for k + 1 moves on. Window 0 is the untimed start.
    """

    def update(self, k: int) -> Update:
        """Solve window k."""
        ...


class Ctmhe:
    """This library, called as a user calls it: the newest sample is given, then the estimate asked for."""

    def __init__(self, problem: Problem, mode: str, compiled: bool, **tuned: float):
        options: dict[str, Any] = dict(tuned)
        if accepts("compile"):
            options["compile"] = "auto" if compiled else "off"
        elif compiled:
            raise Unavailable("this version of ctmhe has no compiled models")
        if mode == ONE:
            options["max_iterations"] = 1
        self.problem, self.mhe = problem, build(problem, **options)
        if compiled and not getattr(self.mhe, "compiled", True):
            raise Unavailable("no C compiler was found")
        starter = build(problem, **{**options, "max_iterations": 100}) if mode == ONE else self.mhe
        self.start = grow(starter, problem)
        self.restart()
        if mode == ONE:
            self.update(1)
            if self.pending[1].status.outcome not in (Outcome.SOLVED, Outcome.ITERATION_LIMIT) or any(
                "reference" in rung for rung in self.pending[1].status.rungs
            ):
                raise Unavailable("max_iterations=1 is no real-time iteration here: the failure ladder goes on")

    def restart(self) -> None:
        """Go back to window 0."""
        self.kept, self.pending, self.k = self.start[0], self.start, 0

    def update(self, k: int) -> Update:
        """Solve window k."""
        if k > self.k:
            self.kept, self.k = self.pending[0], k
        if k == 0:
            estimate = self.pending[1]
        else:
            j = self.problem.count + k
            state = observe(self.mhe, self.kept, self.problem, j)
            state, estimate = self.mhe.estimate(state, j * self.problem.interval)
            self.pending = state, estimate
        return Update(estimate.cost, estimate.x, estimate.status.success, estimate.status.iterations)


@dataclass(frozen=True, eq=False)
class Program:
    """The windows of a problem as one NLP with the prior, the samples and the inputs as parameters.

    Decisions are ordered x_0, w_0, x_1, w_1, ..., x_N and then p, or, for solvers that want stages only, with p as
    states that stay constant. All costs are squares of `residuals`.
    """

    nlp: dict[str, Any]
    residuals: Any
    lower: Array
    upper: Array
    symbolic: bool
    nx: int
    nw: int
    tail: int  # parameters after the last stage


def program(problem: Problem, *, augmented: bool) -> Program:
    """Write a problem as it is usually written: one loop over the stages."""
    model, n, step = problem.model, problem.count, problem.step
    symbolic = step.is_a("SXFunction")
    kind: Any = ca.SX if symbolic else ca.MX
    nx, nw, ny, npar, nu = (len(getattr(model, key)) for key in "xwypu")
    inside = npar if augmented else 0
    prior, samples, inputs = kind.sym("prior", nx + npar), kind.sym("y", ny, n), kind.sym("u", nu, n)
    tail = kind.sym("p", 0 if augmented else npar)
    roots = {key: np.linalg.cholesky(getattr(problem, key)).T for key in "PQR"}
    x_low, x_high = (
        np.concatenate([side, extra[:inside]]) for side, extra in zip(problem.x_box, problem.p_box, strict=True)
    )
    x = kind.sym("x0", nx + inside)
    decisions, gaps, residuals = [x], [], []
    lower, upper = [x_low], [x_high]
    residuals.append(np.sqrt(problem.prior_factor) * ca.mtimes(roots["P"], ca.vertcat(x[:nx], x[nx:], tail) - prior))
    for i in range(n):
        w = kind.sym(f"w{i}", nw)
        p = x[nx:] if augmented else tail
        x_next, y = step(x[:nx], w, p, inputs[:, i])
        x_next = ca.vertcat(x_next, x[nx:])
        residuals.append(np.sqrt(problem.w_factors[i]) * ca.mtimes(roots["Q"], w))
        x = kind.sym(f"x{i + 1}", nx + inside)
        if symbolic:  # the sample belongs to the next node, where the output needs no integration
            y = model.output(0, x[:nx], inputs[:, i], w, p)
        residuals.append(np.sqrt(problem.y_factors[i]) * ca.mtimes(roots["R"], y - samples[:, i]))
        decisions += [w, x]
        gaps.append(x - x_next)
        lower += [problem.w_box[0], x_low]
        upper += [problem.w_box[1], x_high]
    if not augmented:
        decisions.append(tail)
        lower.append(problem.p_box[0])
        upper.append(problem.p_box[1])
    r = ca.vertcat(*residuals)
    nlp = {
        "x": ca.vertcat(*decisions),
        "p": ca.veccat(prior, samples, inputs),
        "f": ca.sumsqr(r),
        "g": ca.vertcat(*gaps),
    }
    return Program(
        nlp, r, np.concatenate(lower), np.concatenate(upper), symbolic, nx + inside, nw, 0 if augmented else npar
    )


def gauss_newton(program: Program, plugin: str) -> ca.Function:
    """Return the Hessian of the Lagrangian without the curvature of residuals and dynamics, in a plugin's form."""
    kind: Any = ca.SX if program.symbolic else ca.MX
    z, g = program.nlp["x"], program.nlp["g"]
    jacobian = ca.jacobian(program.residuals, z)
    lam_f, lam_g = kind.sym("lam_f"), kind.sym("lam_g", g.numel())
    hessian = 2 * lam_f * ca.mtimes(jacobian.T, jacobian)
    half = plugin == "ipopt"
    return ca.Function(
        "nlp_hess_l",
        [z, program.nlp["p"], lam_f, lam_g],
        [ca.triu(hessian) if half else hessian],
        ["x", "p", "lam_f", "lam_g"],
        ["triu_hess_gamma_x_x" if half else "hess_gamma_x_x"],
    )


@dataclass(frozen=True)
class Recipe:
    """How one of CasADi's solvers is set up.

    `exact` asks for second derivatives; where there are none (an integrator inside), and for the others, the Hessian
    is Gauss-Newton's. `duals` hands the shifted multipliers over.
    """

    plugin: str
    options: dict[str, Any] = field(default_factory=dict)
    one: dict[str, Any] | None = None  # what limits the solver to one iteration
    exact: bool = False
    duals: bool = False
    augmented: bool = False
    scalar_only: bool = False
    structured: bool = False


QUIET = {"print_time": False, "error_on_fail": False}
IPOPT = {**QUIET, "ipopt.print_level": 0, "ipopt.sb": "yes"}
SQP = {
    **QUIET, "print_header": False, "print_iteration": False, "print_status": False, "max_iter": 50,
    "tol_pr": 1e-6, "tol_du": 1e-4, "min_step_size": 0.0, "show_eval_warnings": False,
}  # fmt: skip
ONE_STEP = {"max_iter": 1, "max_iter_ls": 0}
RECIPES = {
    "ipopt": Recipe("ipopt", IPOPT, exact=True),
    "ipopt-warm": Recipe(
        "ipopt",
        {
            **IPOPT, "ipopt.warm_start_init_point": "yes", "ipopt.mu_init": 1e-6,
            "ipopt.warm_start_bound_push": 1e-8, "ipopt.warm_start_bound_frac": 1e-8,
            "ipopt.warm_start_slack_bound_push": 1e-8, "ipopt.warm_start_slack_bound_frac": 1e-8,
            "ipopt.warm_start_mult_bound_push": 1e-8,
        },
        exact=True, duals=True,
    ),
    "fatrop": Recipe(
        "fatrop", {**QUIET, "structure_detection": "auto", "fatrop.print_level": 0, "fatrop.mu_init": 1e-3},
        exact=True, augmented=True, scalar_only=True, structured=True,
    ),
    "sqp-hpipm": Recipe(
        "sqpmethod",
        {**SQP, "qpsol": "hpipm", "qpsol_options": {"hpipm": {"mode": "speed"}, "error_on_fail": False}},
        ONE_STEP, augmented=True,
    ),
    "sqp-qrqp": Recipe(
        "sqpmethod",
        {**SQP, "qpsol": "qrqp", "qpsol_options": {"print_iter": False, "print_header": False, "error_on_fail": False}},
        ONE_STEP, duals=True, augmented=True,  # with p as one variable: 0.7 s instead of 6 ms on P3
    ),
}  # fmt: skip


class Casadi:
    """One of CasADi's solvers on the NLP, warm-started by the last solution shifted by one interval."""

    def __init__(
        self, recipe: Recipe, made: Program, problem: Problem, reference: Reference, mode: str, **tuned: float
    ):
        options = recipe.options | tuned
        if mode == ONE:
            if recipe.one is None:
                raise Unavailable("has no one-iteration mode worth the name")
            options |= recipe.one
        self.problem, self.reference, self.recipe = problem, reference, recipe
        self.program = made
        if recipe.structured:
            options["equality"] = [True] * made.nlp["g"].numel()
        if not (recipe.exact and made.symbolic):
            options["hess_lag"] = gauss_newton(made, recipe.plugin)
        self.options = options
        self.solver = ca.nlpsol("solver", recipe.plugin, made.nlp, options)
        self.step = problem.step
        n, nx, nw = problem.count, made.nx, made.nw
        p = reference.p[: nx - len(problem.model.x)]
        nodes = np.hstack([reference.x, np.tile(p, (n + 1, 1))])
        stages = np.hstack([nodes[:-1], reference.w]).reshape(-1)
        guess = np.concatenate([stages, nodes[-1], reference.p[: made.tail]])
        size = n * (nx + nw) + nx
        assert len(guess) == size + made.tail
        self.guess = guess
        self.restart()

    def restart(self) -> None:
        """Go back to before window 0."""
        self.kept: tuple[Array, Array | None, Array | None] = (self.guess, None, None)
        self.pending, self.k = self.kept, 0

    def update(self, k: int) -> Update:
        """Solve window k."""
        if k > self.k:
            self.kept, self.k = self.pending, k
        z, lam_x, lam_g = self.kept
        y, u = self.problem.window(k)
        start: dict[str, Any] = {"x0": self._shifted(z, u[-1]) if k else z}
        if self.recipe.duals and lam_x is not None and lam_g is not None:
            nx, nw, tail = self.program.nx, self.program.nw, self.program.tail
            n = self.problem.count * (nx + nw) + nx
            start["lam_x0"] = np.concatenate([lam_x[nx + nw : n], np.zeros(nx + nw), lam_x[n : n + tail]])
            start["lam_g0"] = np.concatenate([lam_g[nx:], np.zeros(nx)])
        try:
            result = self.solver(
                **start,
                p=np.concatenate([self.reference.priors[k], y.reshape(-1), u.reshape(-1)]),
                lbx=self.program.lower,
                ubx=self.program.upper,
                lbg=0.0,
                ubg=0.0,
            )
            stats = self.solver.stats()
        except RuntimeError:
            return Update(float("nan"), np.full(self.program.nx, np.nan), False, 0)
        z, lam_x, lam_g = (np.asarray(result[key]).reshape(-1) for key in ("x", "lam_x", "lam_g"))
        self.pending = z, lam_x, lam_g
        end = self.problem.count * (self.program.nx + self.program.nw)
        x_end = z[end : end + len(self.problem.model.x)]
        return Update(float(result["f"]), x_end, bool(stats["success"]), int(stats.get("iter_count", 0)))

    def _shifted(self, z: Array, u: Array) -> Array:
        nx, nw, tail = self.program.nx, self.program.nw, self.program.tail
        n = self.problem.count * (nx + nw) + nx
        w, end = np.zeros(nw), z[n - nx : n]
        own = len(self.problem.model.x)
        p = end[own:] if self.recipe.augmented else z[n:]
        after = np.asarray(self.step(end[:own], w, p, u)[0]).reshape(-1)
        return np.concatenate([z[nx + nw : n], w, after, end[own:], z[n : n + tail]])


class DoMpc:
    """do-mpc's MHE through its `make_step`, with the discount and the prior as time-varying and set parameters.

    Its process noise is added to the state after a step. Ours acts inside the step, so it is an input that is
    measured as zero with noise, which is how do-mpc treats uncertain inputs.
    """

    def __init__(self, problem: Problem, reference: Reference):
        if not problem.steps:
            raise Unavailable("integrates by collocation, not by CVODES: another problem")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                import do_mpc  # pyright: ignore[reportMissingImports]
            except ImportError:
                raise Unavailable("not installed") from None
            self._setup(do_mpc, problem, reference)

    def _setup(self, do_mpc: Any, problem: Problem, reference: Reference) -> None:
        self.problem, self.reference = problem, reference
        model = do_mpc.model.Model("discrete", "SX")
        nx, nw, npar, nu = (len(getattr(problem.model, key)) for key in "xwpu")
        x, w = model.set_variable("_x", "x", (nx, 1)), model.set_variable("_u", "w", (nw, 1))
        p = model.set_variable("_p", "p", (npar, 1)) if npar else ca.SX(0, 1)
        model.set_variable("_p", "prior", (nx + npar, 1))
        factor = model.set_variable("_tvp", "factor", (2, 1))
        u = model.set_variable("_tvp", "u", (nu, 1)) if nu else ca.SX(0, 1)
        x_next, _ = problem.step(x, w, p, u)
        model.set_meas("y", problem.model.output(0, x, u, ca.SX.zeros(nw), p), meas_noise=True)
        model.set_meas("zero", w, meas_noise=True)
        model.set_rhs("x", x_next)
        model.setup()
        mhe = do_mpc.estimator.MHE(model, ["p"] if npar else [])
        mhe.settings.n_horizon, mhe.settings.t_step = problem.count, problem.interval
        mhe.settings.store_full_solution, mhe.settings.meas_from_data = False, False
        mhe.settings.supress_ipopt_output()
        e, v = model.v["y_noise"], model.v["zero_noise"]
        stage = factor[0] * ca.bilin(problem.Q, v, v) + factor[1] * ca.bilin(problem.R, e, e)
        own = ca.vertcat(mhe._x["x"], mhe._p_est["p"]) if npar else mhe._x["x"]
        deviation = own - mhe._p_set["prior"]
        mhe.set_objective(stage, problem.prior_factor * ca.bilin(problem.P, deviation, deviation))
        for side, index in (("lower", 0), ("upper", 1)):
            mhe.bounds[side, "_x", "x"] = problem.x_box[index]
            mhe.bounds[side, "_u", "w"] = problem.w_box[index]
            if npar:
                mhe.bounds[side, "_p_est", "p"] = problem.p_box[index]
        self._feed(mhe, nu)
        mhe.setup()
        mhe.x0, mhe.p_est0 = reference.x[0], reference.p
        mhe.set_initial_guess()
        mhe.opt_x_num["_x", :, -1] = list(reference.x)
        mhe.opt_x_num["_u"] = list(reference.w)
        self.mhe, self.k, self.window = mhe, 0, 0
        self.kept = self._memory()
        self.pending = self.kept

    def _feed(self, mhe: Any, nu: int) -> None:
        problem = self.problem
        parameters, varying, measured = mhe.get_p_template(), mhe.get_tvp_template(), mhe.get_y_template()
        for i in range(problem.count):
            varying["_tvp", i, "factor"] = [problem.w_factors[i], problem.y_factors[i]]
        self.window = 0

        def set_parameters(_: float) -> Any:
            parameters["prior"] = self.reference.priors[self.window]
            return parameters

        def set_inputs(_: float) -> Any:
            if nu:
                varying["_tvp", : problem.count, "u"] = list(problem.window(self.window)[1])
            return varying

        def set_samples(_: float) -> Any:
            measured["y_meas", :, "y"] = list(problem.window(self.window)[0])
            return measured

        mhe.set_p_fun(set_parameters)
        mhe.set_tvp_fun(set_inputs)
        mhe.set_y_fun(set_samples)

    def _memory(self) -> tuple[Any, Any]:
        mhe = self.mhe
        duals = (ca.DM(mhe.lam_x_num), ca.DM(mhe.lam_g_num)) if mhe.flags["initial_run"] else None
        return ca.DM(mhe.opt_x_num.master), duals

    def update(self, k: int) -> Update:
        """Solve window k."""
        mhe = self.mhe
        if k > self.k:
            self.kept, self.k = self.pending, k
        mhe.opt_x_num.master = ca.DM(self.kept[0])
        if self.kept[1] is not None:
            mhe.lam_x_num, mhe.lam_g_num = self.kept[1]
        self.window = k
        sample = np.concatenate([self.problem.y[k + self.problem.count], np.zeros(len(self.problem.model.w))])
        x_end = mhe.make_step(sample[:, None]).reshape(-1)
        self.pending = self._memory()
        stats = mhe.solver_stats
        objective = float(stats["iterations"]["obj"][-1])
        return Update(objective, x_end, bool(stats["success"]), int(stats["iter_count"]))


TOOLS = ("ctmhe", *RECIPES, "do-mpc")


def make_tool(name: str, problem: Problem, reference: Reference, mode: str, compiled: bool) -> Tool:
    """Set up a tool.

    Raises
    ------
    Unavailable
        If it is not installed or cannot take the problem or the mode.
    """
    if name == "ctmhe":
        if mode == ONE:
            return Ctmhe(problem, mode, compiled)
        return loosest(lambda tolerance: Ctmhe(problem, mode, compiled, tolerance=tolerance), reference, OURS)
    if compiled:
        raise Unavailable("compiled models are timed for ctmhe only")
    if name == "do-mpc":
        if mode == ONE:
            raise Unavailable("has no one-iteration mode worth the name")
        return DoMpc(problem, reference)
    recipe = RECIPES[name]
    if recipe.scalar_only and not problem.step.is_a("SXFunction"):
        raise Unavailable("no second derivatives through CVODES in reasonable time")
    made = program(problem, augmented=recipe.augmented)
    if recipe.plugin != "sqpmethod" or mode == ONE:
        return Casadi(recipe, made, problem, reference, mode)
    return loosest(
        lambda tolerance: Casadi(recipe, made, problem, reference, CONVERGED, tol_du=tolerance), reference, THEIRS
    )


OURS = (1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9)  # of the cost, relative
THEIRS = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8)  # of the scaled stationarity


def loosest(make: Callable[[float], Any], reference: Reference, tolerances: Sequence[float]) -> Any:
    """Return a tool with the loosest tolerance that reaches the reference's cost in the first windows."""
    tool = None
    for tolerance in tolerances:
        tool = make(tolerance)
        costs = np.array([tool.update(k).cost for k in range(min(len(reference.costs), PROBE))])
        if (np.abs(costs / reference.costs[: len(costs)] - 1) < 0.3 * AGREEMENT).all():
            break
    assert tool is not None
    tool.restart()
    return tool
