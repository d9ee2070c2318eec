import math

import cv2
import numpy as np
import pytest
import torch

from neuido.data import cameras as convert
from neuido.errors import UserError
from neuido.types import Cameras
from tests.data import samples

S = samples.Sample()


def tensor(array) -> torch.Tensor:
    return torch.from_numpy(np.asarray(array, dtype=np.float64))


def pixels(viewmats: torch.Tensor, K=S.K) -> np.ndarray:
    cameras = Cameras(viewmats, tensor(K).expand(len(viewmats), 3, 3), samples.WIDTH, samples.HEIGHT)
    seen, depth = convert.project(tensor(samples.POINT)[None], cameras)
    assert (depth > 0).all()
    return seen[:, 0].numpy()


def test_oracle_against_opencv():
    for v in range(3):
        rotation = cv2.Rodrigues(S.w2c[v, :3, :3])[0]
        there = cv2.projectPoints(samples.POINT[None], rotation, S.w2c[v, :3, 3], S.K, None)[0]
        np.testing.assert_allclose(S.pixels()[v], there.ravel(), atol=1e-9)
    assert (S.pixels() > 0).all() and (S.pixels() < [samples.WIDTH, samples.HEIGHT]).all()


def test_one_point_one_pixel_in_each_convention():
    w2c = tensor(S.w2c)
    quaternions = tensor([samples.quaternion(R) for R in S.w2c[:, :3, :3]])
    vectors = tensor([cv2.Rodrigues(R)[0][:, 0] for R in S.w2c[:, :3, :3]])
    scaled = tensor(S.c2w).clone()
    scaled[:, :3, :3] *= 0.41
    for name, viewmats in {
        "opencv": w2c,
        "opengl": convert.from_opengl(tensor(S.c2w)),
        "opengl, 3 x 4": convert.from_opengl(tensor(S.c2w)[:, :3]),
        "colmap": convert.from_quaternion(3.0 * quaternions, w2c[:, :3, 3]),
        "rodrigues": convert.from_rodrigues(vectors, w2c[:, :3, 3]),
        "neuma's scale": convert.from_opengl(scaled),
    }.items():
        np.testing.assert_allclose(pixels(viewmats), S.pixels(), atol=1e-9, err_msg=name)
        torch.testing.assert_close(viewmats, w2c, atol=1e-12, rtol=0)
    angle = 2 * math.atan(0.5 * samples.WIDTH / samples.FOCAL)
    np.testing.assert_allclose(pixels(w2c, convert.intrinsics(samples.WIDTH, samples.HEIGHT, angle=angle)), S.pixels(), atol=1e-9)


def test_round_trips():
    w2c = tensor(S.w2c)
    torch.testing.assert_close(convert.from_opengl(convert.to_opengl(w2c)), w2c)
    torch.testing.assert_close(convert.from_quaternion(*convert.to_quaternion(w2c)), w2c)
    torch.testing.assert_close(convert.invert(convert.invert(w2c)), w2c)


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.6, 0.0, 0.8)])
@pytest.mark.parametrize("angle", [0.0, 1e-9, 1.0, math.pi - 1e-7, math.pi])
def test_quaternion_at_every_angle(axis, angle):
    viewmat = convert.from_rodrigues(angle * tensor(axis), tensor([1.0, 2.0, 3.0]))
    q, t = convert.to_quaternion(viewmat)
    assert q[0] >= 0 and q.norm() == pytest.approx(1)
    torch.testing.assert_close(convert.from_quaternion(q, t), viewmat, atol=1e-9, rtol=0)
    reference = cv2.Rodrigues(angle * np.array(axis))[0]
    np.testing.assert_allclose(viewmat[:3, :3], reference, atol=1e-9)


def test_nearest_rotation():
    rounded = tensor(np.round(S.c2w[0, :3, :3], 4))
    R, scale = convert.nearest_rotation(0.41 * rounded)
    torch.testing.assert_close(R.mT @ R, torch.eye(3, dtype=R.dtype))
    torch.testing.assert_close(R, tensor(S.c2w[0, :3, :3]), atol=1e-4, rtol=0)
    assert float(scale) == pytest.approx(0.41, abs=1e-4)


@pytest.mark.parametrize(
    ("block", "message"),
    [(np.diag([1, 1, 1.1]), "singular values"), (np.diag([1, 1, -1]), "reflection"), (np.zeros((3, 3)), "singular values")],
)
def test_what_is_no_rotation(block, message):
    with pytest.raises(UserError, match=message):
        convert.nearest_rotation(tensor(block))


def test_look_at_and_orbit():
    viewmat = convert.look_at((1.0, 2.0, 3.0), (0.5, 0.4, 0.5))
    target = viewmat @ tensor([0.5, 0.4, 0.5, 1.0])
    torch.testing.assert_close(target[:2], torch.zeros(2, dtype=torch.float64), atol=1e-12, rtol=0)
    above = viewmat @ tensor([0.5, 0.5, 0.5, 1.0])
    assert target[2] > 0 and above[1] < 0  # y points down in the image
    assert float(torch.linalg.det(viewmat)) == pytest.approx(1)
    with pytest.raises(UserError, match="looks along up"):
        convert.look_at((0.0, 1.0, 0.0), (0.0, 0.0, 0.0))

    cameras = convert.orbit(8, target=(0.5, 0.4, 0.5), radius=2.0, elevations=(10.0, 40.0), angle=50.0, width=320, height=200)
    centres = convert.invert(cameras.viewmats)[:, :3, 3] - torch.tensor([0.5, 0.4, 0.5])
    torch.testing.assert_close(centres.norm(dim=1), torch.full((8,), 2.0))
    torch.testing.assert_close(centres[:, 1], 2 * torch.tensor([10.0, 40.0] * 4).deg2rad().sin())
    middle, _ = convert.project(torch.tensor([[0.5, 0.4, 0.5]]), cameras)
    torch.testing.assert_close(middle, torch.tensor([160.0, 100.0]).expand(8, 1, 2), atol=1e-3, rtol=0)
    with pytest.raises(UserError, match="view_count"):
        convert.orbit(0)
    with pytest.raises(UserError, match="elevations"):
        convert.orbit(2, elevations=(90.0,))


def test_resize_keeps_the_place_in_the_image():
    cameras = Cameras(tensor(S.w2c), tensor(S.K).expand(3, 3, 3), samples.WIDTH, samples.HEIGHT)
    seen, _ = convert.project(tensor(samples.POINT)[None], convert.resize(cameras, 12, 4))
    np.testing.assert_allclose(seen[:, 0], S.pixels() * [0.5, 0.25], atol=1e-9)


def test_move_takes_the_image_along():
    turn = convert.from_rodrigues(tensor([0.3, -0.2, 0.9]), tensor([0.0, 0.0, 0.0]))[:3, :3]
    cameras = Cameras(tensor(S.w2c), tensor(S.K).expand(3, 3, 3), samples.WIDTH, samples.HEIGHT)
    moved = convert.move(cameras, scale=0.8, rotation=turn, shift=(0.1, 0.2, -0.3))
    point = 0.8 * turn @ tensor(samples.POINT) + tensor([0.1, 0.2, -0.3])
    seen, depth = convert.project(point[None], moved)
    np.testing.assert_allclose(seen[:, 0], S.pixels(), atol=1e-9)
    torch.testing.assert_close(depth, 0.8 * convert.project(tensor(samples.POINT)[None], cameras)[1])
    with pytest.raises(UserError, match="scale"):
        convert.move(cameras, scale=0.0)


def test_select():
    cameras = Cameras(tensor(S.w2c), tensor(S.K).expand(3, 3, 3), samples.WIDTH, samples.HEIGHT)
    torch.testing.assert_close(convert.select(cameras, [2, 0]).viewmats, tensor(S.w2c[[2, 0]]))


@pytest.mark.parametrize("given", [{}, {"focal": 3.0, "angle": 1.0}, {"angle": 4.0}, {"focal": -1.0}])
def test_intrinsics_refuses(given):
    with pytest.raises(UserError):
        convert.intrinsics(10, 10, **given)
