"""Pictures without a display: areas, depths, what hides what, shadows, and where the camera stands."""

import numpy as np
import pytest

from neuido import Plane, UserError
from neuido.viewer.content import Content, Motion
from neuido.viewer.picture import Painter, View, camera_of
from neuido.viewer.shading import Backdrop, Shape, draw
from neuido.viewer.surfaces import DepthBuffer, Eye

FRONT = Eye(np.eye(3), np.array([0.0, 0.0, -2.0]), 100.0, 1.0, (50.0, 40.0), 100, 80)
"""A camera at z = -2 that looks along +z, with 50 px per metre at z = 0."""


def test_a_sphere_covers_its_disc_and_is_nearest_in_the_middle():
    buffer = DepthBuffer(FRONT, 0.01)
    buffer.spheres(np.zeros((1, 3)), 0.4)
    drawn = buffer.item() == 0
    assert drawn.sum() == pytest.approx(np.pi * 20.0**2, rel=0.02)
    assert buffer.depth()[40, 50] == pytest.approx(1.6, abs=0.01) and np.isinf(buffer.depth()[0, 0])


def test_the_nearer_item_is_seen_whatever_is_drawn_first():
    near, far = np.array([[0.0, 0.0, -0.5]]), np.array([[0.0, 0.0, 0.5]])
    for order in ((near, far), (far, near)):
        buffer = DepthBuffer(FRONT, 0.01)
        for points in order:
            buffer.spheres(points, 0.2)
        assert buffer.depth()[40, 50] == pytest.approx(1.3, abs=0.01)


def test_a_triangle_covers_its_area_with_the_right_depth():
    corners = np.array([[[-0.6, -0.4, 0.0], [0.6, -0.4, 0.0], [-0.6, 0.4, 1.0]]])
    buffer = DepthBuffer(FRONT, 0.01)
    buffer.triangles(corners)
    a, b, c = FRONT.pixels(FRONT.seen(corners[0]))[0]
    area = 0.5 * abs((b - a)[0] * (c - a)[1] - (b - a)[1] * (c - a)[0])
    assert (buffer.item() == 0).sum() == pytest.approx(area, rel=0.03)
    row, column = np.round((a + b + c) / 3 - 0.5).astype(int)[::-1]
    ray = np.array([(column + 0.5 - 50) / 100, (row + 0.5 - 40) / 100, 1.0])  # the plane is z = 1.25 (y + 0.4)
    assert buffer.depth()[row, column] == pytest.approx((0.5 + 2.0) / (1 - 1.25 * ray[1]), rel=1e-4)


def test_what_is_outside_or_behind_the_camera_is_not_drawn():
    buffer = DepthBuffer(FRONT, 0.01)
    buffer.spheres(np.array([[0.0, 0.0, -3.0], [9.0, 0.0, 0.0], [np.nan, 0.0, 0.0]]), 0.3)
    buffer.triangles(np.array([[[0.0, 0.0, -3.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]]))
    assert (buffer.item() == -1).all()


def test_a_body_darkens_the_floor_below_it_and_hides_it():
    floor, up = (Plane((0.0, 0.0, 0.0), (0.0, 1.0, 0.0)),), np.array([0.0, 1.0, 0.0])
    content = Content("ball", [Motion("ball", np.zeros(1), np.array([[[0.0, 0.3, 0.0]]], np.float32))], planes=floor)
    eye = camera_of(content, View(eye=(0.0, 1.2, 1.5), look_at=(0.0, 0.1, 0.0), width=120, height=90))
    backdrop = Backdrop(eye, floor, np.zeros(3), 1.0, up)
    ball = Shape(np.array([[0.0, 0.3, 0.0]]), np.array([[250, 20, 20]], np.uint8), 0.15)
    bare, drawn = draw([], backdrop), draw([ball], backdrop)
    red = drawn[..., 0] > 2 * drawn[..., 2]
    darker = (bare.sum(axis=2) - drawn.sum(axis=2) > 60) & ~red
    assert 200 < red.sum() < 3000 and darker.sum() > 100


def moving(frames: int = 3) -> Content:
    x = np.random.default_rng(0).random((1, 200, 3)).astype(np.float32) * 0.2
    shift = np.linspace(0, 0.5, frames, dtype=np.float32)[:, None, None] * np.array([1, 0, 0], np.float32)
    times = np.linspace(0.0, 0.1, frames)
    return Content("cloud", [Motion("cloud", times, x + shift)], times=times)


def test_everything_is_in_the_picture_by_default():
    content = moving()
    for frame in range(3):
        eye = camera_of(content, View(width=160, height=120))
        place = eye.pixels(eye.seen(content.motions[0].x[frame]))[0]
        assert (place > 0).all() and (place < (160, 120)).all()
    width = np.ptp(eye.pixels(eye.seen(content.motions[0].x.reshape(-1, 3)))[0], axis=0)
    assert max(width / (160, 120)) > 0.5


def test_pictures_differ_with_frame_and_quantity_and_have_a_legend():
    content = moving()
    view = View(width=96, height=72)
    first = Painter(content, "speed", view).picture(0)
    assert first.shape == (72, 96, 3) and first.dtype == np.uint8
    assert (first != Painter(content, "speed", view).picture(2)).any()
    plain = Painter(content, "speed", view, legend=False).picture(0)
    assert (first != plain).sum() > 100


@pytest.mark.parametrize(
    ("view", "told"),
    [
        (View(fov=0.0), "fov is 0"),
        (View(width=2), "width and height are 2"),
        (View(eye=(0.0, 0.0, 0.0), look_at=(0.0, 0.0, 0.0)), "cannot look at"),
        (View(eye=(0.0, 2.0, 0.0), look_at=(0.0, 0.0, 0.0)), "right above or below"),
        (View(camera="left"), "no cameras"),
    ],
)
def test_impossible_views_are_one_line(view, told):
    with pytest.raises(UserError, match=told) as failed:
        camera_of(moving(), view)
    assert "\n" not in str(failed.value)
