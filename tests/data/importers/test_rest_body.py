import numpy as np
import pytest

from neuido.data.importers.deforming import VELOCITY_FRAMES, start_velocity
from neuido.data.importers.rest_body import FILL, rest_body
from neuido.errors import UserError

T = 0.01 * np.arange(8)
RNG = np.random.default_rng(0)
LATTICE = np.stack(np.meshgrid(*[np.linspace(-0.15, 0.15, 5)] * 3, indexing="ij"), -1).reshape(-1, 3)
MARKERS = LATTICE[RNG.permutation(125)[:60]]
GRADIENT = np.array([[3.0, -5.0, 0.0], [5.0, -3.0, 0.0], [0.0, 0.0, 0.0]])
VELOCITY = np.array([1.2, 1.0, 0.3]) + MARKERS @ GRADIENT.T


def moved(noise):
    x = MARKERS + T[:, None, None] * VELOCITY - 0.5 * 9.81 * T[:, None, None] ** 2 * np.array([0.0, 1.0, 0.0])
    return x + noise * RNG.standard_normal(x.shape)


def test_start_of_noisy_points_is_a_linear_field():
    found, kind = start_velocity(T, moved(4e-4))
    single = np.gradient(moved(4e-4), T, axis=0)[0]
    assert "a linear field" in kind
    assert np.std(found - VELOCITY) < 0.5 * np.std(single - VELOCITY)
    exact, _ = start_velocity(T, moved(0.0))
    np.testing.assert_allclose(exact, VELOCITY, atol=1e-9)


def test_start_that_is_no_linear_field_is_kept():
    bending = 20 * np.stack([0 * MARKERS[:, 0], MARKERS[:, 0] ** 2, 0 * MARKERS[:, 0]], 1)
    found, kind = start_velocity(T, moved(1e-5) + T[:, None, None] * bending)
    assert kind == "of each point"
    np.testing.assert_allclose(found, VELOCITY + bending, atol=5e-3)
    gaps = moved(1e-5)
    gaps[1, 3] = np.nan
    found, _ = start_velocity(T, gaps)
    np.testing.assert_allclose(found[3], VELOCITY[3], atol=1e-2)
    gaps[: VELOCITY_FRAMES // 2 + 1] = np.nan
    with pytest.raises(UserError, match="no point is seen in all of the first"):
        start_velocity(T, gaps)


def test_markers_are_filled_and_a_lattice_is_the_body():
    body = rest_body(MARKERS, VELOCITY, None, "a")
    assert body.filled and 0.7 * FILL < len(body.x0) < 1.3 * FILL and "filled with" in body.note
    np.testing.assert_allclose(body.v0, np.array([1.2, 1.0, 0.3]) + body.x0 @ GRADIENT.T, atol=1e-9)
    larger = rest_body(MARKERS, VELOCITY, 2 * body.volume, "a")
    grown = np.ptp(larger.x0, axis=0) / np.ptp(body.x0, axis=0)
    assert larger.volume == 2 * body.volume and len(larger.x0) == pytest.approx(len(body.x0), rel=0.1)
    np.testing.assert_allclose(grown, 2 ** (1 / 3), rtol=0.1)
    whole = rest_body(LATTICE, 0 * LATTICE, None, "a")
    assert not whole.filled and len(whole.x0) == 125 and whole.spacing == pytest.approx(0.075)
    assert whole.volume == pytest.approx(0.027)


def test_points_in_a_plane():
    plane = MARKERS * [1, 1, 0]
    with pytest.raises(UserError, match="lie in a plane and enclose no volume: give --volume"):
        rest_body(plane, VELOCITY, None, "a")
    sheet = rest_body(plane, VELOCITY, 1e-4, "a")
    assert not sheet.filled and sheet.volume == 1e-4


def test_markers_on_the_faces_of_a_cube_carry_their_velocities_inside():
    grid = np.stack(np.meshgrid(*[np.linspace(0, 0.1, 8)] * 3, indexing="ij"), -1).reshape(-1, 3)
    faces = grid[((grid == grid.min()) | (grid == grid.max())).any(axis=1)]
    body = rest_body(faces, faces @ GRADIENT.T, None, "cube")
    assert body.filled
    np.testing.assert_allclose(body.v0, body.x0 @ GRADIENT.T, atol=1e-9)
