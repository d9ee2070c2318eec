import numpy as np
import pytest

import neuido
from neuido.data.measured.motion_plausibility import check_flight, mask_unseen
from neuido.data.measured.plausibility import check_order, check_stress, check_stretches
from neuido.errors import UserError

MODEL = {"elasticity": {"law": "neo_hookean", "young": 1e6, "poisson": 0.49}}
PATH = np.linspace(1, 2, 21)[:, None]
STRESS = 3.3e5 * (PATH - PATH**-2)


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (1e-6, r"about 1e-06 times .* scale 1.0e\+6"),
        (1e-3, r"scale 1.0e\+3"),
        (1e3, "scale 1.0e-3"),
        (0, "zero in all 21"),
        (-1, "negative factor"),
    ],
)
def test_stress(factor, words):
    check_stress(PATH, STRESS, MODEL, "a", timed=False)
    with pytest.raises(UserError, match=words):
        check_stress(PATH, factor * STRESS, MODEL, "a", timed=False)


def test_stretches_and_order():
    check_stretches(PATH, "a")
    check_order(PATH[:, 0], "a")
    check_order(1 + 0.3 * np.sin(np.linspace(0, 40, 300)), "cycles")
    with pytest.raises(UserError, match="percent"):
        check_stretches(100 * (PATH - 0.95), "a")
    with pytest.raises(UserError, match="loading order"):
        check_order(np.random.default_rng(0).permutation(PATH[:, 0]), "a")


@pytest.mark.parametrize(
    ("scale", "words"),
    [(-200, "the unit is not metres and y points down"), (1000, "the unit is not metres;"), (-1, "model.gravity: y points down")],
)
def test_flight(scale, words):
    t = np.linspace(12.3, 13.3, 31)
    y = 1.5 + 4 * (t - t[0]) - 4.905 * (t - t[0]) ** 2 + np.random.default_rng(0).normal(0, 2e-3, 31)
    check_flight(t, y, -9.81, "y", "a")
    with pytest.raises(UserError, match=words):
        check_flight(t, scale * y, -9.81, "y", "a")


def test_unseen_markers():
    x = np.random.default_rng(0).normal(1, 0.1, (5, 4, 3))
    gaps = x.copy()
    gaps[1, 2], gaps[3, 0] = 0, -9999
    with pytest.warns(UserWarning, match="count as not seen"):
        seen = mask_unseen(gaps, "a")
    assert np.isnan(seen).all(axis=2).sum() == 2 and (seen[0] == x[0]).all()
    still = x.copy()
    still[:, 1] = 0  # a point that is held at the origin
    assert np.isfinite(mask_unseen(np.concatenate([still, 1e-6 * x]), "a")).any()
    with pytest.raises(UserError, match="no point of x was seen"):
        mask_unseen(np.full((3, 2, 3), np.nan), "a")


@pytest.mark.parametrize(
    ("name", "reader", "words"),
    [
        ("21-track-pixels-y-down", "read_tracks", "scale: {y: -0.005}"),
        ("22-material-MPa-unscaled", "read_material_tests", r"scale 1.0e\+6"),
        ("23-material-strain-percent", "read_material_tests", "strains in percent"),
        ("25-material-unsorted", "read_material_tests", "loading order"),
        ("28-experiment-x-in-mm", "read_experiment", "millimetres"),
        ("29-experiment-all-unseen", "read_experiment", "no point of x was seen"),
        ("30-material-zero-stress", "read_material_tests", "zero in all 25 rows"),
    ],
)
def test_cases_are_refused(data_root, name, reader, words):
    with pytest.raises(UserError, match=words):
        getattr(neuido, reader)(data_root / "cases" / name)


def test_case_of_markers_at_zero(data_root):
    with pytest.warns(UserWarning, match="count as not seen"):
        take, _ = neuido.read_experiment(data_root / "cases" / "27-experiment-marker-zeros").recordings
    assert 0.03 < 1 - take.seen.float().mean() < 0.07
