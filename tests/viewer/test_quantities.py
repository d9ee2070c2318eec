"""Quantities against closed forms, and the words of the legend."""

import numpy as np
import pytest

from neuido.viewer.quantities import Quantity, equivalent_strain, quantities_of, readable, symmetric_eigenvalues, von_mises


def test_eigenvalues_agree_with_lapack():
    A = np.random.default_rng(0).normal(size=(200, 3, 3))
    A = A @ A.transpose(0, 2, 1)
    A[0], A[1] = np.eye(3), np.diag([2.0, 2.0, 5.0])
    assert np.allclose(symmetric_eigenvalues(A), np.linalg.eigvalsh(A)[:, ::-1], atol=1e-9)


def test_strain_of_an_isochoric_stretch_and_of_a_turn():
    stretch = 1.3
    F = np.diag([stretch, stretch**-0.5, stretch**-0.5])[None]
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert equivalent_strain(F) == pytest.approx(np.log(stretch), rel=1e-6)
    assert equivalent_strain(turn @ F @ turn.T) == pytest.approx(np.log(stretch), rel=1e-6)
    assert equivalent_strain(1.5 * np.eye(3)[None]) == pytest.approx(0.0, abs=1e-7)


def test_von_mises_of_tension_shear_and_pressure():
    eye = np.eye(3)[None]
    tension, shear = np.zeros((1, 3, 3)), np.zeros((1, 3, 3))
    tension[0, 0, 0], shear[0, 0, 1], shear[0, 1, 0] = 7.0, 2.0, 2.0
    assert von_mises(tension, eye) == pytest.approx(7.0)
    assert von_mises(shear, eye) == pytest.approx(2.0 * np.sqrt(3.0))
    assert von_mises(5.0 * eye, eye) == pytest.approx(0.0)
    assert von_mises(tension, 2.0 ** (1 / 3) * eye) == pytest.approx(3.5)  # Cauchy's stress is Kirchhoff's over det F


def test_plastic_strain_is_what_the_elastic_gradient_lacks():
    axis = np.arange(5) * 0.1
    x0 = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    total = np.diag([1.2, 1.0, 1 / 1.2])
    elastic = np.diag([1.05, 1.0, 1 / 1.05])
    F = np.stack([np.tile(np.eye(3), (len(x0), 1, 1)), np.tile(elastic, (len(x0), 1, 1))])
    found = quantities_of(np.array([0.0, 1.0]), np.stack([x0, x0 @ total.T]), None, F)["plastic strain"].values(1)
    plastic = np.log(1.2) - np.log(1.05)
    assert np.allclose(found, 2 / np.sqrt(3) * plastic, rtol=1e-6)


def test_speed_comes_from_positions_where_there_are_no_velocities():
    times = np.array([0.0, 0.5, 1.0])
    x = np.stack([np.full((3, 3), 2.0 * t) for t in times])
    speeds = quantities_of(times, x)["speed"]
    assert np.allclose(speeds.values(1), 2.0 * np.sqrt(3.0)) and np.allclose(speeds.values(0), 2.0 * np.sqrt(3.0))


def test_points_that_were_not_seen_have_a_colour_and_no_say_in_the_range():
    values = np.array([0.0, 1.0, np.nan, 2.0])
    one = Quantity("speed", "m/s", lambda k: values, 1)
    assert one.range[0] == 0.0 and 1.9 < one.range[1] <= 2.0
    assert one.colours(0).shape == (4, 3)
    assert not (one.colours(0)[0] == one.colours(0)[3]).all()
    assert len(set(one.colours(0)[2])) == 1  # grey, and no colour of the legend
    assert not (one.colours(0)[2] == one.colours(0)).all(axis=1)[[0, 1, 3]].any()


def test_legend_has_readable_units():
    one = Quantity("von Mises stress", "Pa", lambda k: np.array([0.0, 2.5e4]), 1)
    assert one.legend() == ("von Mises stress [kPa]", "0", "24.5")
    assert readable(0.002, "m") == (pytest.approx(1000.0), "mm") and readable(0.3, "") == (1.0, "")
    ratio = Quantity("volume ratio", "", lambda k: np.array([0.9, 1.0, 1.2]), 1, 1.0)
    assert sum(ratio.range) == pytest.approx(2.0)
