"""Flow curves: each effect of a fluid by its closed form, the memory of a thixotropic fluid, and slopes by the parameters."""

import numpy as np
import pytest

from neuido.errors import UserError
from neuido.physics.points.flow_curve import flow_stress

VISCOSITY, RATES = 3.0, np.geomspace(1e-2, 1e2, 9)


def stress(rate=RATES, time=None, viscosity=VISCOSITY, **values):
    given = {name.replace("__", "."): np.array([value]) for name, value in values.items()}
    return flow_stress(np.array([viscosity]), given, np.asarray(rate, dtype=float), time)[0]


def test_newton():
    np.testing.assert_allclose(stress(), VISCOSITY * RATES)


def test_a_power_law_has_its_slope_and_its_reference():
    tau = stress(power_law__n=-0.4, power_law__reference=2.0)
    np.testing.assert_allclose(np.diff(np.log(tau)) / np.diff(np.log(RATES)), 0.6)
    assert stress([2.0], power_law__n=-0.4, power_law__reference=2.0)[0] == pytest.approx(2 * VISCOSITY)


def test_carreau_has_two_limits():
    """A constant viscosity below the rate 1/time, and a power of the rate beyond it."""
    slow, fast = stress([1e-4, 1e4], carreau__n=-0.7, carreau__time=0.5)
    assert slow == pytest.approx(VISCOSITY * 1e-4, rel=1e-6)
    assert fast == pytest.approx(VISCOSITY * 1e4 * (0.5 * 1e4) ** -0.7, rel=1e-6)
    assert stress([2.0], carreau__n=-0.7, carreau__time=0.5)[0] == pytest.approx(2 * VISCOSITY * 2**-0.35)


def test_bingham_and_herschel_bulkley():
    np.testing.assert_allclose(stress(bingham__yield=5.0), 5.0 + VISCOSITY * RATES)
    tau = stress(herschel_bulkley__yield=5.0, herschel_bulkley__n=-0.5, herschel_bulkley__reference=4.0)
    np.testing.assert_allclose(tau, 5.0 + VISCOSITY * RATES * np.sqrt(4.0 / RATES))
    np.testing.assert_allclose(stress(herschel_bulkley__yield=5.0, herschel_bulkley__n=0.0), stress(bingham__yield=5.0))


THIXOTROPIC = {"thixotropy__c": 4.0, "thixotropy__breakdown": 0.5, "thixotropy__build": 0.2}


def test_a_thixotropic_fluid_at_one_rate_falls_exponentially():
    """z' = a (1 - z - b g z) at a constant rate g: z = z1 + (1 - z1) exp(-a t / z1), z1 = 1 / (1 + b g)."""
    rate, t = 6.0, np.linspace(0.0, 10.0, 41)
    z1 = 1 / (1 + 0.5 * rate)
    z = z1 + (1 - z1) * np.exp(-0.2 * (t + t[1]) / z1)  # the first row has lasted as long as the next ones
    np.testing.assert_allclose(stress(np.full(41, rate), t, **THIXOTROPIC), VISCOSITY * rate * (1 + 4.0 * z), rtol=1e-12)
    np.testing.assert_allclose(stress([rate], **THIXOTROPIC), VISCOSITY * rate * (1 + 4.0 * z1))


def test_rates_up_and_down_enclose_a_loop_that_slow_changes_close():
    rates = np.concatenate([RATES, RATES[-2::-1]])
    open_, closed = (stress(rates, pace * np.arange(len(rates)), **THIXOTROPIC) for pace in (2.0, 1e4))
    assert (open_[:8] > open_[:8:-1]).all()  # built up on the way up
    np.testing.assert_allclose(closed[:8], closed[:8:-1], rtol=1e-9)
    np.testing.assert_allclose(closed, stress(rates, **THIXOTROPIC), rtol=1e-9)


def test_steps_of_time_do_not_matter():
    coarse = stress(np.full(3, 6.0), np.array([1.0, 2.0, 3.0]), **THIXOTROPIC)[-1]
    fine = stress(np.full(31, 6.0), np.arange(0.0, 3.05, 0.1)[:31], **THIXOTROPIC)
    assert fine[29] == pytest.approx(coarse, rel=1e-9)  # both after three seconds


@pytest.mark.parametrize(
    ("name", "values", "slope"),
    [
        ("power_law__n", {"power_law__reference": 2.0, "power_law__n": -0.4},
         lambda: stress(power_law__n=-0.4, power_law__reference=2.0) * np.log(RATES / 2.0)),
        ("carreau__time", {"carreau__n": -0.7, "carreau__time": 0.5},
         lambda: stress(carreau__n=-0.7, carreau__time=0.5) * -0.7 * 0.5 * RATES**2 / (1 + (0.5 * RATES) ** 2)),
        ("bingham__yield", {"bingham__yield": 5.0}, lambda: np.ones(9)),
        ("herschel_bulkley__n", {"herschel_bulkley__n": -0.5, "herschel_bulkley__yield": 5.0},
         lambda: VISCOSITY * RATES**0.5 * np.log(RATES)),
        ("thixotropy__c", THIXOTROPIC, lambda: VISCOSITY * RATES / (1 + 0.5 * RATES)),
        ("thixotropy__breakdown", THIXOTROPIC, lambda: -VISCOSITY * RATES * 4.0 * RATES / (1 + 0.5 * RATES) ** 2),
    ],
)  # fmt: skip
def test_slopes_by_the_parameters(name, values, slope):
    h = 1e-6
    ends = [stress(**(values | {name: values[name] + sign * h})) for sign in (1, -1)]
    np.testing.assert_allclose((ends[0] - ends[1]) / (2 * h), slope(), rtol=1e-5)


def test_what_is_no_flow_is_said():
    with pytest.raises(UserError, match="shear rates must be positive, got 0"):
        stress([0.0, 1.0])
    with pytest.raises(UserError, match=r"creep\.rate is no effect of a fluid"):
        stress(creep__rate=1.0)
