"""What is odd in folders made by hand is a line with the row, the value and the key to change."""

import warnings

import numpy as np
import pytest

from neuido.data.measured.motion_plausibility import (
    check_figures,
    check_flight,
    check_motion,
    check_positions,
    check_track,
    check_upright,
    lost_positions,
)
from neuido.data.measured.plausibility import check_density, check_rows, check_stress
from neuido.errors import PlausibilityWarning, UserError

MODEL = {"elasticity": {"law": "neo_hookean", "young": 1e6, "poisson": 0.49}}
PATH = np.linspace(1, 2, 21)[:, None]
STRESS = 3.3e5 * (PATH - PATH**-2)
T = np.linspace(0, 1, 31)
FLIGHT = np.stack([2 * T, 1.5 + 4 * T - 4.905 * T**2], 1) + np.random.default_rng(0).normal(0, 1e-3, (31, 2))


@pytest.fixture
def no_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error", PlausibilityWarning)
        yield


@pytest.mark.usefixtures("no_warning")
def test_what_is_plausible_is_silent():
    check_stress(PATH, STRESS, MODEL, "a", timed=False)
    check_rows(PATH, STRESS, np.arange(21.0), "a")
    check_rows(np.ones((21, 1)), STRESS[::-1], np.geomspace(0.01, 1e4, 21), "relaxation")
    check_track(T, FLIGHT, "xy", "a")
    check_track(T, FLIGHT - FLIGHT[0], "xy", "a flight from the origin")
    check_flight(T, 1.5 - 0.3 * T, -9.81, "y", "a balloon that sinks")
    check_figures("ball", {"mass": 0.057, "diameter": 0.066})
    check_density(930.0)


@pytest.mark.parametrize("density", [1.1, 1.1e-6, 1.1e6])
def test_a_density_in_another_unit(density):
    with pytest.warns(PlausibilityWarning, match="kg/m.3 is that of no soft or solid body: check the unit"):
        check_density(density)


def test_a_stiff_curve_in_another_unit_is_refused_by_its_start():
    """A J-shaped curve rises a hundredfold; the start tells the unit."""
    stiff = STRESS * np.exp(5 * (PATH - 1))
    check_stress(PATH, stiff, MODEL, "a", timed=False)
    with pytest.raises(UserError, match=r"about 0\.001 times model\.elasticity\.young .* scale 1\.0e\+3"):
        check_stress(PATH, 1e-3 * stiff, MODEL, "a", timed=False)
    with pytest.warns(PlausibilityWarning, match="times model.elasticity.young = 1e.06 Pa: check the unit"):
        check_stress(PATH, STRESS / 50, MODEL, "a", timed=False)


@pytest.mark.parametrize(
    ("path", "stress", "time", "words"),
    [
        (np.repeat(PATH, 3, axis=0), np.repeat(STRESS, 3, axis=0), None, r"42 of 63 rows repeat the one before \(data row 1\)"),
        (PATH, np.where(np.arange(21)[:, None] == 7, 9e6, STRESS), None, r"jumps to 9e\+06 Pa in data row 7 and back"),
        (np.hstack([PATH, PATH]), np.hstack([STRESS, 0 * STRESS]), None, "stress 2 is zero in all rows"),
        (PATH, STRESS, np.linspace(0, 1e10, 21), r"lasts 1e\+10 s; are the times in ms"),
    ],
)
def test_odd_rows(path, stress, time, words):
    with pytest.warns(PlausibilityWarning, match=words):
        check_rows(path, stress, time, "a")


@pytest.mark.parametrize(
    ("t", "x", "words"),
    [
        (T, np.where(np.arange(31)[:, None] == 12, 7.0, FLIGHT), "jumps to 7 m in data row 12 and back"),
        (T, np.column_stack([FLIGHT[:, 1], 0 * T]), "y is 0 in all 31 rows: leave it out of columns"),
        (T, 1e4 * FLIGHT, "travels .* m; are the positions in mm or pixels"),
        (np.where(np.arange(31) > 20, T + 9, T), FLIGHT, r"9\.03 s lie between data rows 20 and 21"),
        (T, 0.5 * np.stack([np.sin(np.sin(9 * T)), 1 - np.cos(np.sin(9 * T))], 1), r"on a circle of 0\.5 m, as on a pivot"),
    ],
)
def test_odd_tracks(t, x, words):
    with pytest.warns(PlausibilityWarning, match=words):
        check_track(t, x, "xy", "a")


def test_impossible_tracks():
    with pytest.raises(UserError, match="at the same place in all 31 rows"):
        check_track(T, np.full((31, 2), 0.3), "xy", "a")
    unseen = FLIGHT + 5
    unseen[[4, 9]] = 0
    with pytest.raises(UserError, match="data row 4 has 0, 0, as of a point that was not seen, and 1 rows more"):
        check_track(T, unseen, "xy", "a")
    unseen[9, 1] = -9999
    assert list(np.flatnonzero(lost_positions(unseen))) == [4, 9]
    with pytest.raises(UserError, match=r"give 3\.79e\+05 kg/m\^3, more than any solid has; is the mass in g"):
        check_figures("ball", {"mass": 57.0, "diameter": 0.066})
    with pytest.warns(PlausibilityWarning, match="less than air; is the diameter in mm"):
        check_figures("ball", {"mass": 0.057, "diameter": 66.0})


@pytest.mark.parametrize(("factor", "words"), [(1e3, r"scale: \{t: 0\.001\}"), (30, r"times in ms or frames\? .*t: 0\.0333")])
def test_times_in_another_unit(factor, words):
    with pytest.raises(UserError, match=words):
        check_flight(factor * T, FLIGHT[:, 1], -9.81, "y", "a")


def test_odd_bodies():
    rng = np.random.default_rng(0)
    x0 = rng.uniform(0.4, 0.6, (40, 3))
    v0, volume, gravity = np.tile([1.0, 2.0, 0.0], (40, 1)), np.full(40, 0.008 / 40), (0.0, -9.81, 0.0)
    t = 0.01 * np.arange(8)
    x = x0 + t[:, None, None] * v0[0] + 0.5 * t[:, None, None] ** 2 * np.array(gravity)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_motion(x, t, x0, v0, volume, gravity, "a")
    for options, words in (
        ({"v0": 1e3 * v0}, r"v0 has 2\.24e\+03 m/s"),
        ({"volume": 1e9 * volume}, r"volumes add up to 8e\+06 m\^3"),
        ({"x": np.repeat(x[:1], 8, axis=0)}, "no point moves in any of 8 frames"),
        ({"t": np.where(np.arange(8) > 5, t + 1, t)}, "s lie between data rows 5 and 6"),
    ):
        given = {"x": x, "t": t, "x0": x0, "v0": v0, "volume": volume} | options
        with pytest.warns(PlausibilityWarning, match=words):
            check_motion(**given, gravity=gravity, where="a")
    with pytest.raises(UserError, match="y points down"):
        check_motion(x * [1, -1, 1], t, x0, v0, volume, gravity, "a")
    with pytest.warns(PlausibilityWarning, match=r"positions lie outside scene\.domain, the first of point \d+ in frame \d at"):
        check_positions(x, x0, np.arange(40), np.zeros(3), np.array([0.61, 1.0, 1.0]), "a")


def test_another_vertical_is_refused_only_where_nothing_else_can_be_meant():
    """A level circle of 1 g, and a throw downwards that drag brakes, are warned of; a plain throw along another axis is refused."""
    t = np.linspace(0, 0.8, 40)
    angle = np.sqrt(9.81 / 4.0) * (t - 0.4)
    circle = np.stack([4 * np.sin(angle), 0 * t, 4 * np.cos(angle)], 1)
    gravity, noise = [0.0, -9.81, 0.0], 1e-3 * np.random.default_rng(0).standard_normal((40, 3))
    plain = np.stack([t, 0.5 * t, 2 * t - 4.905 * t**2], 1)
    with pytest.raises(UserError, match=r"z is as of gravity, so z is the vertical\. Give --up z"):
        check_upright(t, plain + noise, gravity, "xyz", "a")
    with pytest.warns(PlausibilityWarning, match=r"is \(.*, -9.* and gravity is declared along y: if z is the vertical, give --up z"):
        check_upright(t, circle + noise, gravity, "xyz", "a")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_upright(t, plain[:, [0, 2, 1]] + noise, gravity, "xyz", "a")
    with pytest.warns(PlausibilityWarning, match="y points down, or drag or lift turns it"):
        check_flight(t, -15 * (1 - np.exp(-t)) + noise[:, 1], -9.81, "y", "a")  # thrown down, braked by twice its weight
