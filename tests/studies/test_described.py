"""Studies from TOML files: what a file says is what is run, and what it says wrongly is named."""

from __future__ import annotations

import pickle
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmhe import MHE, RK4, DiscountedCost, Network, Periodic, SingleSample, Uniform, simulate
from ctmhe.errors import CtmheError, InputError
from ctmhe.models.library import batch_reactor
from ctmhe.studies.described import DescribedCase, changed
from ctmhe.studies.study_file import load_study
from fmus.build import build

TEXT = """
[study]
until = 0.4
monitor = 0.05
seeds = 2

[plant]
model = "batch_reactor"
truth = { pA = 3.0, pB = 1.0 }

[disturbance]
v_pressure = { kind = "Uniform", bound = 0.02 }

[estimator]
horizon = 0.4
interval = 0.1
integrator = { kind = "RK4", step = 0.1 }
cost = { P = 0.1, Q = 1e3, R_point = 1e4 }
bounds = "model"
hold = "point"

[guess]
pA = 2.0
pB = 2.0

[channel]
kind = "SingleSample"

[trigger]
name = "Periodic"
period = 0.1

[grid]
"trigger.period" = [0.1, 0.2]
"""


@pytest.fixture(autouse=True)
def uncompiled(monkeypatch):
    """Models run as tapes: nothing is compiled for so short runs."""
    monkeypatch.setenv("CTMHE_COMPILE", "off")


def written(folder, text):
    """Write a study file and return its path."""
    path = folder / "study.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_described_run_is_the_run_that_python_makes(tmp_path):
    """To the last bit, with loss on the way."""
    text = TEXT.replace('kind = "SingleSample"', 'kind = "SingleSample"\n[channel.network]\nloss = 0.3')
    described = load_study(written(tmp_path, text)).case(seed=5, **{"trigger.period": 0.05})
    model = batch_reactor(noise=False)
    mhe = MHE(
        model,
        horizon=0.4,
        interval=0.1,
        integrator=RK4(step=0.1),
        cost=DiscountedCost(P=0.1, Q=1e3, R_point=1e4),
        bounds=model.bounds,
        hold="point",
    )
    direct = simulate(
        batch_reactor(),
        mhe,
        trigger=Periodic(0.05),
        until=0.4,
        monitor=0.05,
        truth=[3.0, 1.0],
        guess=[2.0, 2.0],
        channel=Network(SingleSample(), loss=0.3),
        disturbance={"v_pressure": Uniform(0.02)},
        seed=5,
    )
    np.testing.assert_array_equal(described.dataset["x_online"], direct.dataset["x_online"])
    assert described.messages_lost == direct.messages_lost > 0


def test_a_case_is_small_on_its_way_and_the_same_on_arrival(tmp_path):
    """It pickles as its tables, whatever it has built."""
    case = load_study(written(tmp_path, TEXT)).case
    before = case(seed=0)
    content = pickle.dumps(case)
    assert len(content) < 2000
    np.testing.assert_array_equal(pickle.loads(content)(seed=0).dataset["x_online"], before.dataset["x_online"])


def test_an_fmu_is_found_from_the_file_and_crosses_by_path(tmp_path):
    """Its path starts at the TOML file's folder; plant and model are the same file."""
    fmu = build("batch_reactor", fmi=2)
    (tmp_path / "plants").mkdir()
    (tmp_path / "plants" / "reactor.fmu").write_bytes(Path(fmu).read_bytes())
    text = TEXT.replace('model = "batch_reactor"', 'fmu = "plants/reactor.fmu"\ninputs = []')
    text = text.replace("[estimator]", "[model]\ninputs = []\n[estimator]").replace('bounds = "model"\n', "")
    case = load_study(written(tmp_path, text)).case
    assert isinstance(case, DescribedCase) and len(pickle.dumps(case)) < 2000
    run = case(seed=0)
    assert run.samples == 5 and run.online_rms() < 2.0
    np.testing.assert_array_equal(run.dataset["x_online"], case(seed=0).dataset["x_online"])


def test_polling_can_be_asked_for(tmp_path):
    """`locate = false` stands for None, which TOML cannot say."""
    text = TEXT.replace("monitor", "locate = false\nmonitor").replace(
        'name = "Periodic"\nperiod', 'name = "SendOnDelta"\ndelta'
    )
    case = load_study(written(tmp_path, text.replace("trigger.period", "trigger.delta"))).case
    assert case(seed=0).dataset.attrs["location"] == "polled every 0.05 s"


def test_labels_and_values_become_the_design(tmp_path):
    """Whole tables have labels, values are their own."""
    grid = '[grid.trigger]\neven = { name = "Periodic", period = 0.1 }\nlate = { name = "Periodic", period = 0.2 }\n'
    study = load_study(
        written(tmp_path, TEXT.replace('"trigger.period" = [0.1, 0.2]', '"guess.pA" = [1.0, 2.0]') + grid)
    )
    assert study.design.parameters == ("guess.pA", "trigger")
    assert study.design.labels == ((1.0, "even"), (1.0, "late"), (2.0, "even"), (2.0, "late"))
    assert study.study().seeds == (0, 1) and study.name == "study"


def test_ranges_are_sampled_and_lists_make_a_grid_beside_them(tmp_path):
    """Eight points inside the range, each with both guesses."""
    text = TEXT.replace("seeds = 2", 'seeds = 2\ndesign = "sobol"\npoints = 8')
    text = text.replace("[0.1, 0.2]", '{ low = 0.05, high = 0.5, log = true }\n"guess.pA" = [1.0, 2.0]')
    design = load_study(written(tmp_path, text)).design
    periods = {dict(zip(design.parameters, row, strict=True))["trigger.period"] for row in design.labels}
    assert len(design) == 16 and len(periods) == 8 and all(0.05 <= p <= 0.5 for p in periods)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[plant]", "[plnt]", "unknown key 'plnt'; did you mean 'plant'"),
        ("until =", "untl =", "table [study]: unknown key 'untl'; did you mean 'until'"),
        ("until = 0.4\n", "", "table [study] needs until"),
        ("truth =", "turth =", "table [plant]: unknown key 'turth'; did you mean 'truth'"),
        ('model = "batch_reactor"', 'model = "batch_reacter"', "expected one of batch_reactor"),
        ('model = "batch_reactor"\n', "", "table [plant] needs model"),
        ('model = "batch_reactor"', 'fmu = "nowhere.fmu"', "nowhere.fmu"),
        ("v_pressure", "v_presure", "table [disturbance]: unknown key 'v_presure'; did you mean 'v_pressure'"),
        ('kind = "Uniform"', 'kind = "Normal"', "expected one of Uniform, Gaussian, got 'Normal'"),
        ("bound = 0.02", "bund = 0.02", "table [disturbance]: v_pressure"),
        ("horizon", "horizn", "table [estimator]: unknown key 'horizn'; did you mean 'horizon'"),
        ('bounds = "model"', 'bounds = "plant"', 'bounds is a table, or "model"'),
        ("pA = 2.0", "pC = 2.0", "table [guess]: unknown key 'pC'"),
        ('kind = "SingleSample"', 'kind = "SinglSample"', "expected one of WholeSignal, SingleSample"),
        ('kind = "SingleSample"', 'kind = "SingleSample"\nevery = 0.1', "table [channel]: unknown key 'every'"),
        ('kind = "SingleSample"', 'kind = "SingleSample"\nnetwork = { los = 1 }', "did you mean 'loss'"),
        ('name = "Periodic"', 'name = "Periodik"', "did you mean 'Periodic'"),
        ('name = "Periodic"', 'name = "policy.py:Mine"', "a configuration may not name a file"),
        ('"trigger.period" =', '"trigger.perod" =', "[grid] trigger.perod = 0.1: trigger 'Periodic'"),
        ('"trigger.period" =', '"triger.period" =', "table [grid]: unknown key 'triger'; did you mean 'trigger'"),
        ('"trigger.period" =', "trigger.period =", 'put it in quotes: "trigger.period" = [...]'),
        ('"trigger.period" =', '"trigger.any.0.x" =', "[grid] trigger.any.0.x = 0.1: trigger"),
        ('"trigger.period" = [0.1, 0.2]', '"trigger.period" = 0.1', "expected a list of values"),
        ("[0.1, 0.2]", "{ low = 0.1, high = 0.2 }", 'needs design = "latin-hypercube" or "sobol"'),
        ("seeds = 2", 'seeds = 2\ndesign = "sobol"', "needs ranges"),
        ("seeds = 2", 'seeds = 2\ndesign = "halton"', "expected one of grid, latin-hypercube, sobol"),
        ("[study]", "[study", "is not valid TOML"),
    ],
)
def test_mistakes_are_found_before_anything_runs(tmp_path, old, new, message):
    """File, table and key are named, with the nearest known one."""
    assert old in TEXT
    path = written(tmp_path, TEXT.replace(old, new, 1))
    with pytest.raises(CtmheError, match=re.escape(message)):
        load_study(path)


KEYS = st.lists(st.sampled_from(["a", "b", "c"]), min_size=1, max_size=4).map(".".join)


@settings(max_examples=60, deadline=None)
@given(st.dictionaries(KEYS, st.integers(), max_size=4))
def test_what_is_changed_is_there_and_the_tables_stay_as_they_were(point):
    """The longest keys win inside; the original never changes."""
    tables = {"a": {"b": {"c": 0}}, "b": [{"a": 1}]}
    try:
        result = changed(tables, point)
    except InputError:
        return
    assert tables == {"a": {"b": {"c": 0}}, "b": [{"a": 1}]}
    for key, value in point.items():
        if not any(other.startswith(f"{key}.") for other in point):
            place = result
            for part in key.split("."):
                place = place[part]
            assert place == value


def test_a_number_in_a_key_counts_in_a_list():
    """From 0, and not past its end."""
    tables = {"trigger": {"any": [{"delta": 1}, {"seconds": 2}]}}
    assert changed(tables, {"trigger.any.1.seconds": 5})["trigger"]["any"] == [{"delta": 1}, {"seconds": 5}]
    with pytest.raises(InputError, match="'2' counts the 2 entries of a list"):
        changed(tables, {"trigger.any.2.seconds": 5})
