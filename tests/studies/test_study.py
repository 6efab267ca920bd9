"""Studies: the same numbers wherever they are computed, and a row for whatever goes wrong."""

from __future__ import annotations

import logging
import threading
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial

import pandas as pd
import pytest

from ctmhe import MHE, RK4, DiscountedCost, FmuModel, FmuPlant, Periodic, SendOnDelta, Study, WholeSignal, simulate
from ctmhe.errors import InputError
from ctmhe.studies.metrics import TIMINGS
from fmus.build import build
from tests.studies.cases import Reactor, draw, troubled

TROUBLES = {
    "raises": "ValueError: as told",
    "leaves": "SystemExit: 3",
    "returns nothing": "InputError: the case returned NoneType (is a return missing?)",
    "returns a list": "InputError: metric 'value': expected a number, a boolean or text, got [1, 2]",
    "takes a name": "InputError: a metric cannot be called 'seed'",
}


def numbers(result):
    """The table without what a clock decides."""
    return result.table.drop(columns=[name for name in TIMINGS if name in result.table])


def same(a, b):
    """Bit for bit."""
    pd.testing.assert_frame_equal(numbers(a), numbers(b), check_exact=True)


def test_the_table_has_a_row_for_every_point_and_seed_in_the_order_of_the_design():
    """Parameters, seed, metrics, error, seconds, key."""
    result = Study(draw, {"gain": [3, 1, 2]}, seeds=[5, 4]).run()
    table = result.table
    assert list(table.columns) == ["gain", "seed", "value", "count", "even", "text", "error", "seconds", "key"]
    assert list(zip(table["gain"], table["seed"], strict=True)) == [(g, s) for g in (3, 1, 2) for s in (5, 4)]
    assert result.parameters == ("gain",) and result.metrics == ("value", "count", "even", "text")
    assert table["value"][3] == draw(gain=1, seed=4)["value"] and (table["error"] == "").all()
    assert table["key"].is_unique


@pytest.mark.parametrize("executor", [None, ProcessPoolExecutor, ThreadPoolExecutor])
def test_a_study_gives_the_same_numbers_on_two_workers_as_on_one(executor):
    """A real case, by our own processes and by executors of the user's; the case is sent once."""
    study = Study(Reactor(), {"policy": {"even": Periodic(0.1), "delta": SendOnDelta(0.1)}}, seeds=2)
    if executor is None:
        same(study.run(workers=2), study.run())
    else:
        with executor(2) as pool:
            same(study.run(executor=pool), study.run())


def test_a_case_may_be_a_local_function_with_policies_of_ones_own():
    """What a notebook holds goes to workers by value."""
    factor = 2.0

    class Mine(Periodic):
        pass

    def case(*, seed, policy):
        return {"value": factor * seed, "kind": type(policy).__name__}

    study = Study(case, {"policy": [Mine(0.1)]}, seeds=3)
    same(study.run(workers=2), study.run())


def test_an_fmu_plant_goes_to_workers_by_path_and_digest():
    """Estimator and plant are FMUs; the numbers are those of one process."""
    path = build("batch_reactor", fmi=2)
    model = FmuModel(path, inputs=[])
    cost = DiscountedCost(eta=0.4, P=0.1, Q=2e3, R=1e2)
    mhe = MHE(model, horizon=1.0, interval=0.1, integrator=RK4(step=0.05), cost=cost)
    plant = FmuPlant(path, inputs=[])

    def case(*, seed, policy):
        channel = WholeSignal(every=0.05)
        return simulate(
            plant, mhe, trigger=policy, until=0.5, monitor=0.05, guess=[0.1, 4.5], channel=channel, seed=seed
        )

    study = Study(case, {"policy": [Periodic(0.1), SendOnDelta(0.1)]}, seeds=1)
    same(study.run(workers=2), study.run())


@pytest.mark.parametrize("workers", [1, 2])
def test_a_run_that_fails_is_a_row_with_its_error(workers):
    """Whatever a case raises or returns; the other runs go on."""
    result = Study(troubled, {"kind": list(TROUBLES)}, seeds=2).run(workers)
    assert len(result.table) == 2 * len(TROUBLES)
    for kind, text in TROUBLES.items():
        rows = result.table[result.table["kind"] == kind]
        assert rows["error"].iloc[0] == "" and rows["error"].iloc[1].startswith(text)
        assert rows["value"].iloc[0] == len(kind) and rows["value"].isna().iloc[1]


def test_a_run_whose_process_dies_is_a_row_and_the_others_are_computed(caplog):
    """Those that ran beside it are done again; the executor that it broke is replaced."""
    study = Study(troubled, {"kind": ["a", "dies", "b", "c"]}, seeds=3)
    own = study.run(workers=2)
    with ProcessPoolExecutor(2) as pool:
        same_death = study.run(executor=pool)
    for result in (own, same_death):
        assert len(result.table) == 12 and len(result.failed) == 1
        assert "the process of this run died (SIGKILL(-9)), twice" in result.failed["error"].iloc[0]
    assert "the executor is broken" in caplog.text


def test_what_cannot_be_sent_is_told_by_name_before_anything_runs():
    """The label of a value, or the case; in one process it may stay."""
    lock, ran = threading.Lock(), []
    grid = {"policy": {"good": 1, "bad": lock}}
    with pytest.raises(
        InputError, match=r"policy='bad' cannot be sent to another process: TypeError: cannot pickle '_th"
    ):
        Study(draw, grid, 1).run(workers=2)
    with pytest.raises(InputError, match="the case cannot be sent"):
        Study(lambda *, seed: ran.append(lock), {}, 1).run(workers=2)
    assert not ran
    assert (Study(draw, grid, 1).run().table["error"] == "").all()


def test_a_failing_run_can_be_repeated_here_with_its_traceback():
    """By number or row."""
    study = Study(troubled, {"kind": ["fine", "raises"]}, seeds=2)
    result = study.run()
    with pytest.raises(ValueError, match="as told"):
        study.repeat(result.failed.iloc[0])
    assert study.repeat(0) == {"value": 4}


def test_metrics_may_be_chosen_and_a_pair_adds_to_those_of_a_run():
    """A wrong name is told with its neighbour."""
    reactor = Reactor()

    def case(*, seed):
        run = reactor(seed=seed, policy=Periodic(0.25))
        return run, {"extra": run.samples / 2}

    result = Study(case, seeds=1, metrics=["extra", "samples", "online_rms.pA"]).run()
    assert result.metrics == ("extra", "samples", "online_rms.pA")
    assert result.table["samples"][0] == 5 and result.table["extra"][0] == 2.5
    with pytest.raises(InputError, match="unknown metric 'sample'; did you mean 'samples'"):
        Study(case, seeds=1, metrics=["sample"]).run()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Study(draw, {"gian": [1.0]}), "does not take (seed, gian)"),
        (lambda: Study(lambda seed, x: {}, {}), "missing a required argument: 'x'"),
        (lambda: Study(3, {}), "the case must be a function"),
        (lambda: Study(draw, {}, seeds=0), "at least one"),
        (lambda: Study(draw, {}, seeds=[1, 1]), "different numbers"),
        (lambda: Study(draw, {}, seeds=[-1]), "at least 0, got -1"),
        (lambda: Study(draw, {}, seeds="12"), "seeds must be whole numbers"),
        (lambda: Study(draw, {}, trajectories=True), "needs folder="),
        (lambda: Study(draw, {}).run(workers=0), "workers must be"),
        (lambda: Study(draw, {}).status(), "this one has none"),
        (lambda: Study(draw, {}, 1).run().run(0), "no trajectory was kept"),
    ],
)
def test_a_study_that_cannot_be_is_told_at_once(make, message):
    """One line, with what was expected."""
    with pytest.raises(InputError, match=message.replace("(", r"\(").replace(")", r"\)")):
        make()


def test_progress_counts_what_is_done_already(tmp_path, capsys):
    """Shown when asked for only."""
    Study(draw, {"gain": [1.0]}, 3, folder=tmp_path).run()
    assert not capsys.readouterr().err
    Study(draw, {"gain": [1.0, 2.0]}, 3, folder=tmp_path).run(progress=True)
    shown = capsys.readouterr().err
    assert "draw:  50%" in shown and "3/6" in shown and "6/6" in shown and "run/s" in shown


def test_a_partial_fixes_what_is_no_parameter():
    """`functools.partial` is how; it is part of the key."""
    a, b = (Study(partial(draw, gain=gain), seeds=2).run() for gain in (1.0, 2.0))
    assert set(a.table["key"]).isdisjoint(b.table["key"])
    assert "Study 'draw'" in repr(Study(partial(draw, gain=1.0)))


def test_a_study_repeats_no_warning_of_its_runs(caplog):
    """What a thousand runs have to say is said once; outside of a study every run says it."""
    logger = logging.getLogger("ctmhe.simulation.engine")

    def case(*, seed):
        logger.warning("something for %s s in the run of seed %d", 0.1 * seed, seed)
        return {"value": seed}

    Study(case, {}, seeds=5).run()
    assert len([record for record in caplog.records if "something for" in record.message]) == 1
    case(seed=7)
    assert "seed 7" in caplog.text
