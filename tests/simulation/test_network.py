"""Laws of a network between sensor and estimator: what arrives when, what is counted, and who knows what."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmhe.errors import InputError
from ctmhe.estimators import MHE
from ctmhe.models.library import batch_reactor
from ctmhe.simulation import Everything, Network, SingleSample, Uniform, WholeSignal, simulate
from ctmhe.simulation.network import _Outages
from ctmhe.transcription.integrators import RK4
from ctmhe.triggers import Innovation, MaxInterval, Periodic
from ctmhe.types import DiscountedCost

OUTPUTS = ("a", "b")


@pytest.fixture(scope="module")
def mhe():
    model = batch_reactor(noise=False)
    cost = DiscountedCost(P=0.1, Q=1e3, R_point=1e4)
    return MHE(model, horizon=1.0, interval=0.1, integrator=RK4(0.05), cost=cost, bounds=model.bounds, hold="point")


def run(mhe, policy, channel, **changes):
    options = {"until": 2.0, "truth": [3.0, 1.0], "guess": [0.1, 4.5], "seed": 5, "monitor": 0.05}
    options["disturbance"] = {"v_pressure": Uniform(0.02)}
    return simulate(batch_reactor(), mhe, trigger=policy, channel=channel, **(options | changes))


def messages(network, count=200, step=0.05, seed=0):
    """Send values 0, 1, 2, ... of two outputs; return what was put on the way, message by message."""
    link = network.open(seed, OUTPUTS)
    return [link.sample(k * step, np.array([k * 1.0, -k * 1.0])) for k in range(count)]


@given(
    st.floats(0, 1),
    st.floats(0, 0.3),
    st.floats(0, 0.3),
    st.booleans(),
    st.integers(0, 2**32),
    st.sampled_from([None, 0.2, 3.0]),
)
@settings(max_examples=60, deadline=None)
def test_a_message_arrives_within_its_limits_or_never(loss, shortest, more, in_order, seed, outage):
    """Delays lie between the limits, in order if so asked; nothing is made up, doubled or altered."""
    network = Network(SingleSample(), loss=loss, delay=(shortest, shortest + more), in_order=in_order, outage=outage)
    sent = messages(network, seed=seed, count=60)
    assert all(len(message) == 1 for message in sent)
    arrivals = [message[0].at for message in sent]
    for k, message in enumerate(sent):
        np.testing.assert_array_equal(message[0].measurement.y, [k, -k])
        assert message[0].measurement.t == k * 0.05
        late = message[0].at - k * 0.05
        limit = np.inf if in_order else shortest + more + 1e-9
        assert np.isinf(late) or shortest - 1e-9 <= late <= limit
    if in_order:
        through = [at for at in arrivals if np.isfinite(at)]
        assert through == sorted(through)
    again = messages(network, seed=seed, count=60)
    assert [message[0].at for message in again] == arrivals


def test_as_many_are_lost_as_asked_for():
    """4000 messages, 30 %: within five standard deviations; none at 0, all at 1."""
    share = {
        loss: np.mean([np.isinf(m[0].at) for m in messages(Network(SingleSample(), loss=loss), 4000)])
        for loss in (0.0, 0.3, 1.0)
    }
    assert share[0.0] == 0.0
    assert share[1.0] == 1.0
    assert abs(share[0.3] - 0.3) < 5 * np.sqrt(0.3 * 0.7 / 4000)


def test_outages_last_as_long_and_take_as_much_time_as_asked_for():
    """Exponential up and down times: a share of time, and a mean length, whoever sends how often."""
    outages = _Outages(0.5, 0.2, seed=1)
    down = np.array([outages.down(t) for t in np.arange(0.0, 20_000.0, 0.05)])
    assert np.mean(down) == pytest.approx(0.2, abs=0.02)
    begins = np.count_nonzero(np.diff(down.astype(int)) == 1)
    assert down.sum() * 0.05 / begins == pytest.approx(0.5, rel=0.15)  # the shortest fall between two looks
    network = Network(SingleSample(), loss=0.2, outage=0.5)
    often = [np.isinf(m[0].at) for m in messages(network, 400, 0.05)]
    seldom = [np.isinf(m[0].at) for m in messages(network, 200, 0.1)]
    assert often[::2] == seldom


@given(st.floats(1e-3, 10.0), st.floats(-1e3, 1e3))
def test_quantisation_is_off_by_half_a_step_at_most(quantum, value):
    """Named outputs are rounded to multiples, others are not; missing ones stay missing."""
    link = Network(SingleSample(), quantum={"b": quantum}).open(0, OUTPUTS)
    row = link.sample(0.0, np.array([value, value]))[0].measurement.y
    assert row[0] == value
    assert abs(row[1] - value) <= quantum / 2 * (1 + 1e-9)
    assert row[1] / quantum == pytest.approx(round(row[1] / quantum), abs=1e-6)
    assert np.isnan(link.sample(1.0, np.array([value, np.nan]))[0].measurement.y[1])


def test_a_clock_that_is_ahead_dates_measurements_later():
    """By its offset, whatever the delay."""
    sent = messages(Network(SingleSample(), clock_offset=0.02, delay=0.1), 5)
    np.testing.assert_allclose([m[0].measurement.t for m in sent], 0.05 * np.arange(5) + 0.02)
    np.testing.assert_allclose([m[0].at for m in sent], 0.05 * np.arange(5) + 0.1)


def test_bytes_are_counted():
    """8 for a record's time, and those of each value that is there."""
    link = Network(SingleSample(), value_bytes=2).open(0, OUTPUTS)
    assert link.sample(0.0, np.array([1.0, 2.0]))[0].bytes == 8 + 2 * 2
    assert link.sample(0.1, np.array([1.0, np.nan]))[0].bytes == 8 + 2
    assert SingleSample().open(0, OUTPUTS).sample(0.0, np.array([1.0, 2.0]))[0].bytes == 8 + 2 * 8


def test_a_perfect_network_is_no_network(mhe):
    """Nothing lost, delayed or rounded: the estimates of the channel alone, and a copy that solves as often."""
    policy = Innovation(0.05) | MaxInterval(0.3)
    alone, through = run(mhe, policy, SingleSample()), run(mhe, policy, Network(SingleSample()))
    for name in ("x_online", "x_hat", "sample_time", "solve_time"):
        np.testing.assert_array_equal(alone.dataset[name], through.dataset[name])
    assert (alone.messages, alone.bytes_sent) == (through.messages, through.bytes_sent)
    assert alone.bytes_sent == 16 * alone.samples
    assert (alone.sensor_solves, through.sensor_solves) == (0, through.solves)


def test_the_trigger_knows_what_was_sent_not_what_arrived(mhe):
    """Sampling instants do not depend on the loss, estimates do; all lost is open loop from the guess."""
    policy = Innovation(0.05) | MaxInterval(0.3)
    runs = {loss: run(mhe, policy, Network(SingleSample(), loss=loss)) for loss in (0.0, 0.5, 1.0)}
    for other in (runs[0.5], runs[1.0]):
        np.testing.assert_array_equal(other.sample_times, runs[0.0].sample_times)
        assert other.messages == other.samples
    assert runs[0.5].solves == runs[0.5].messages - runs[0.5].messages_lost < runs[0.0].solves
    assert runs[1.0].solves == runs[1.0].measurements == 0
    assert runs[1.0].messages_lost == runs[1.0].messages
    state = mhe.init(x=[0.1, 4.5])
    np.testing.assert_allclose(runs[1.0].dataset["x_online"][-1], mhe.predict(state, 2.0).x, rtol=1e-9)


def test_solves_happen_when_messages_arrive(mhe):
    """Sampled at 0, 0.2, ...; 0.07 s on the way; what arrives after the end is not solved for."""
    late = run(mhe, Periodic(0.2), Network(SingleSample(), delay=0.07))
    np.testing.assert_allclose(late.dataset["solve_time"], 0.2 * np.arange(10) + 0.07)
    assert late.samples == 11
    assert late.measurements == late.solves == 10
    assert late.too_late == 0


def test_what_the_window_has_passed_is_dropped_and_counted(mhe):
    """Horizon 1 s, up to 2 s on the way, out of order: some come too late, and the run goes on."""
    late = run(mhe, Periodic(0.1), Network(SingleSample(), delay=(0.0, 2.0)), until=4.0)
    assert late.too_late > 0
    assert late.measurements + late.too_late <= late.messages
    assert np.isfinite(late.dataset["x_online"]).all()


def test_a_whole_signal_is_lost_message_by_message():
    """Records of a lost message are gone; those of the next are not."""
    link = Network(WholeSignal(), loss=0.5).open(3, OUTPUTS)
    fates = []
    for k in range(40):
        for j in range(3):
            assert link.record(k + j / 4, np.zeros(2)) == []
        message = link.sample(k + 0.9, np.zeros(2))
        assert [item.measurement.t for item in message] == [k, k + 0.25, k + 0.5, k + 0.9]
        assert len({item.at for item in message}) == 1
        fates.append(np.isinf(message[0].at))
    assert 0 < sum(fates) < 40


def test_everything_over_a_network_solves_at_the_samples():
    """Records arrive when they do; the trigger decides when to solve."""
    model = batch_reactor()
    cost = DiscountedCost(P=0.1, Q=1e3, R=1e2)
    mhe = MHE(model, horizon=1.0, interval=0.1, integrator=RK4(0.05), cost=cost, bounds=model.bounds)
    result = run(mhe, Periodic(0.5), Network(Everything(every=0.1), delay=0.15))
    np.testing.assert_allclose(result.dataset["solve_time"], [0.0, 0.5, 1.0, 1.5, 2.0])
    assert result.messages == 21
    assert result.measurements == 19  # those of 1.9 and 2.0 s are still on the way


@pytest.mark.parametrize(
    ("wrong", "what"),
    [
        ({"loss": 1.5}, "loss"),
        ({"loss": np.nan}, "loss"),
        ({"delay": -0.1}, "delay"),
        ({"delay": (0.2, 0.1)}, "delay"),
        ({"outage": 0.0}, "outage"),
        ({"quantum": -1.0}, "quantum"),
        ({"clock_offset": np.inf}, "clock_offset"),
        ({"value_bytes": 0}, "value_bytes"),
    ],
)
def test_nonsense_is_refused_by_name(wrong, what):
    """Each error names the argument."""
    with pytest.raises(InputError, match=what):
        Network(SingleSample(), **wrong)


def test_a_network_wraps_a_channel_and_knows_the_outputs(mhe):
    """No network within a network, no quantum for an output that does not exist."""
    with pytest.raises(InputError, match="expected WholeSignal"):
        Network(Network(SingleSample()))
    with pytest.raises(InputError, match=r"unknown output 'presure'.*pressure"):
        run(mhe, Periodic(0.2), Network(SingleSample(), quantum={"presure": 0.1}))
