"""State events of the bouncing ball and time events of the switched heater, where closed forms say."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

fmpy = pytest.importorskip("fmpy")

BALL = {"e": 0.8, "g": 9.0}
HEIGHT, REST_SPEED = 1.0, 0.1  # where the ball starts, and the speed below which it rests


def impacts():
    """Times of all impacts, and the speeds after them; the last one is below the speed of rest."""
    t, speed = np.sqrt(2 * HEIGHT / BALL["g"]), np.sqrt(2 * HEIGHT * BALL["g"])
    found = []
    while True:
        speed *= BALL["e"]
        found.append((t, speed))
        if speed < REST_SPEED:
            return np.array(found).T
        t += 2 * speed / BALL["g"]


def flight(t):
    """Height at time t."""
    times, speeds = impacts()
    k = np.searchsorted(times, t) - 1
    if k < 0:
        return HEIGHT - BALL["g"] / 2 * t**2
    since = t - times[k]
    return 0.0 if k == len(times) - 1 else speeds[k] * since - BALL["g"] / 2 * since**2


# ---- the ball ----


def test_a_step_returns_early_at_each_impact(opened):
    """FMI 3 co-simulation in event mode: steps end at t = sqrt(2 h / g), and at all later impacts."""
    ball = opened("bouncing_ball", 3, "CoSimulation", start=BALL, event_mode_used=True, early_return_allowed=True)
    times, speeds = impacts()
    ball.fmu.enterStepMode()
    t, end, seen = 0.0, times[-1] + 1.0, []
    while t < end:
        event, terminate, early, last = ball.fmu.doStep(t, end - t)
        assert event == early == (last < end)
        assert not terminate
        t = last
        if event:
            seen.append(t)
            assert ball.named("floor") <= 0.0
            ball.fmu.enterEventMode()
            assert ball.event() == (True, None)
            ball.fmu.enterStepMode()
            expected = speeds[len(seen) - 1] if len(seen) < len(times) else 0.0
            np.testing.assert_allclose(ball.named("velocity"), expected, rtol=1e-10)
    np.testing.assert_allclose(seen, times, rtol=1e-12)
    assert ball.named("bounces") == len(times)
    np.testing.assert_array_equal(ball.get("x"), [0.0, 0.0])


@pytest.mark.parametrize("mode", [{}, {"event_mode_used": True}, {"early_return_allowed": True}])
def test_without_early_return_the_ball_bounces_inside_its_step(opened, mode):
    """FMI 3: unless both event mode and early return are agreed on, a step ends where it was to end."""
    ball = opened("bouncing_ball", 3, "CoSimulation", start=BALL, **mode)
    if mode.get("event_mode_used"):
        ball.fmu.enterStepMode()
    assert ball.fmu.doStep(0.0, 2.0) == (False, False, False, 2.0)
    np.testing.assert_allclose(ball.named("height"), flight(2.0), rtol=1e-10)


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("count", [1, 7, 400])
def test_cosimulation_of_the_ball_is_its_closed_form(opened, fmi, count):
    """However the time is divided into steps, the height is that of parabolas between impacts, then zero."""
    ball = opened("bouncing_ball", fmi, "CoSimulation", start=BALL)
    times = np.linspace(0.0, 5.0, count + 1)
    for t0, t1 in pairwise(times):
        ball.fmu.doStep(t0, t1 - t0)
        np.testing.assert_allclose(ball.named("height"), flight(t1), rtol=0, atol=1e-11)
    assert impacts()[0][-1] < 5.0
    assert ball.named("resting") == 1.0


@pytest.mark.parametrize("fmi", [2, 3])
def test_an_impact_in_model_exchange_changes_the_states(opened, fmi):
    """Below the floor the indicator is negative; the event iteration turns the velocity, and it is positive again."""
    ball = opened("bouncing_ball", fmi)
    ball.fmu.enterContinuousTimeMode()
    np.testing.assert_array_equal(ball.indicators(), [HEIGHT])
    ball.set_states([-1e-9, -4.0])
    np.testing.assert_array_equal(ball.indicators(), [-1e-9])
    ball.fmu.enterEventMode()
    assert ball.event() == (True, None)
    ball.fmu.enterContinuousTimeMode()
    np.testing.assert_allclose(ball.states(), [0.0, 0.7 * 4.0], rtol=1e-15, atol=1e-300)
    assert ball.indicators() > 0.0
    assert ball.named("bounces") == 1.0


@pytest.mark.parametrize("fmi", [2, 3])
def test_an_event_away_from_the_floor_changes_nothing(opened, fmi):
    """Event iterations that no impact asked for leave states and discrete variables as they are."""
    ball = opened("bouncing_ball", fmi)
    for x in ([0.5, -3.0], [-1e-9, 3.0]):  # in the air; on its way up
        ball.set_states(x)
        assert ball.event() == (False, None)
        np.testing.assert_array_equal(ball.states(), x)
    np.testing.assert_array_equal(ball.get("q"), [0.0, 0.0])


@pytest.mark.parametrize("fmi", [2, 3])
def test_a_slow_impact_is_the_last(opened, fmi):
    """After a bounce of less than 0.1 m/s the ball rests: derivatives are zero and the indicator stays positive."""
    ball = opened("bouncing_ball", fmi)
    ball.set_states([0.0, -0.14])
    assert ball.event() == (True, None)
    np.testing.assert_array_equal(ball.states(), [0.0, 0.0])
    np.testing.assert_array_equal(ball.derivatives(), [0.0, 0.0])
    assert ball.indicators() > 0.0
    assert not ball.jacobian("x")[:2].any()


@pytest.mark.parametrize("fmi", [2, 3])
def test_an_integrator_finds_the_impacts(unzipped, fmi):
    """Model exchange in fmpy's CVODE with its root finder: the impacts are those of the closed form."""
    got = fmpy.simulate_fmu(
        unzipped("bouncing_ball", fmi),
        fmi_type="ModelExchange",
        stop_time=2.0,
        output_interval=0.5,
        relative_tolerance=1e-9,
        start_values=BALL,
        output=["bounces"],
    )
    seen = got["time"][1:][np.diff(got["bounces"]) > 0]
    times = impacts()[0]
    assert len(seen) >= 3
    np.testing.assert_allclose(seen, times[times < 2.0], rtol=0, atol=1e-6)  # its tolerances add up over bounces


# ---- the heater ----

PERIOD, POWER, RESISTANCE, ROOM, TAU = 300.0, 500.0, 0.1, 293.15, 0.1 * 1e4


def temperature(t):
    """Exponentials between multiples of the period, heated in even ones."""
    value = ROOM
    for k in range(int(t // PERIOD) + 1):
        goal = ROOM + (RESISTANCE * POWER if k % 2 == 0 else 0.0)
        value = goal + (value - goal) * np.exp(-min(PERIOD, t - k * PERIOD) / TAU)
    return value


@pytest.mark.parametrize("fmi", [2, 3])
def test_the_next_toggling_is_planned(opened, fmi):
    """Model exchange: each event names the next multiple of the period, and the heater toggles there only."""
    heater = opened("switched_heater", fmi)
    for t, on, after in [(0.0, 1, 300.0), (299.0, 1, 300.0), (300.0, 0, 600.0), (450.0, 0, 600.0), (600.0, 1, 900.0)]:
        heater.fmu.setTime(t)
        assert heater.event() == (False, after)
        assert heater.named("on") == on
        np.testing.assert_allclose(heater.derivatives(), [on * 0.05], rtol=1e-15)  # power / C, at T = T_room


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("step", [7.0, 300.0, 1500.0])
def test_cosimulation_of_the_heater_is_its_closed_form(opened, fmi, step):
    """Steps that end before, at and after the togglings give the same exponentials."""
    heater = opened("switched_heater", fmi, "CoSimulation")
    for k in range(int(1500.0 / step)):
        heater.fmu.doStep(k * step, step)
        np.testing.assert_allclose(heater.named("T"), temperature((k + 1) * step), rtol=1e-12)


def test_a_step_returns_early_at_each_toggling(opened):
    """FMI 3 co-simulation in event mode: steps end at the multiples of the period, exactly."""
    mode = {"event_mode_used": True, "early_return_allowed": True}
    heater = opened("switched_heater", 3, "CoSimulation", **mode)
    heater.fmu.enterStepMode()
    for k in (1, 2, 3):
        step = 1000.0 if k < 3 else PERIOD  # the third event lies at the end of the step, which is not early
        assert heater.fmu.doStep((k - 1) * PERIOD, step) == (True, False, k < 3, k * PERIOD)
        assert heater.named("on") == k % 2  # until the event is handled
        heater.fmu.enterEventMode()
        assert heater.event() == (False, (k + 1) * PERIOD)
        heater.fmu.enterStepMode()
        assert heater.named("on") == (k + 1) % 2
    np.testing.assert_allclose(heater.named("T"), temperature(3 * PERIOD), rtol=1e-12)


@pytest.mark.parametrize("fmi", [2, 3])
def test_an_integrator_meets_the_togglings(unzipped, fmi):
    """Model exchange in fmpy follows the exponentials through the togglings."""
    got = fmpy.simulate_fmu(
        unzipped("switched_heater", fmi),
        fmi_type="ModelExchange",
        stop_time=1000.0,
        output_interval=100.0,
        relative_tolerance=1e-10,
        output=["T"],
    )
    np.testing.assert_allclose(got["T"], [temperature(t) for t in got["time"]], rtol=1e-7)
