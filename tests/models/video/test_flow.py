"""Optical flow of a known motion, its image, its window and its cache."""

from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
import torch

from neuido.data.cameras import orbit
from neuido.errors import UserError
from neuido.models.video import flow as module
from neuido.models.video.flow import (
    body_window,
    colour_wheel,
    encode_flow,
    flow_image,
    frame_interval_of,
    measure_velocities,
    optical_flow,
    pixel_length,
)


def texture(size=96):
    noise = np.random.default_rng(0).random((size, size, 3), dtype=np.float32)
    return cv2.GaussianBlur(noise, (0, 0), 2.0)


def shifted(step, frames=4, size=96):
    image = texture(size)
    rows = []
    for k in range(frames):
        move = np.float32([[1, 0, k * step[0]], [0, 1, k * step[1]]])
        rows.append(cv2.warpAffine(image, move, (size, size), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT))
    video = np.stack(rows)
    return torch.from_numpy((video - video.min()) / (video.max() - video.min()))


def test_flow_of_a_known_shift():
    flow = optical_flow(shifted((1.5, -0.75)))
    assert flow.shape == (3, 96, 96, 2)
    middle = flow[:, 16:-16, 16:-16]
    assert (middle - torch.tensor([1.5, -0.75])).norm(dim=-1).mean() < 0.1


def test_flow_of_several_videos_is_that_of_each():
    videos = torch.stack([shifted((1.0, 0.0)), shifted((0.0, -2.0))])
    together = optical_flow(videos)
    assert torch.equal(together[1], optical_flow(videos[1]))


@pytest.mark.parametrize(("preset", "worst"), [("medium", 0.1), ("fast", 0.15), ("ultrafast", 0.2)])
def test_flow_of_all_pairs_at_once_is_that_of_opencv(preset, worst):
    videos = [shifted((1.5, -0.75)), shifted((-0.5, 2.5))]
    pairwise, parallel = (optical_flow(videos, preset=preset, method=method) for method in ("opencv", "parallel"))
    inside = (slice(None), slice(None), slice(16, -16), slice(16, -16))
    assert parallel.shape == pairwise.shape and (parallel - pairwise)[inside].norm(dim=-1).mean() < worst
    true = torch.tensor([[1.5, -0.75], [-0.5, 2.5]])[:, None, None, None]
    assert (parallel - true)[inside].norm(dim=-1).mean() < worst
    alone = optical_flow(videos[1], preset=preset, method="parallel")
    assert torch.equal(parallel[1], alone)  # no pair reaches over the end of its video


def test_flow_at_once_bends_as_that_of_opencv():
    """A rotation and a growth about a point, whose flow changes from pixel to pixel."""
    centre, image = 47.5, texture()
    turn = cv2.getRotationMatrix2D((centre, centre), 3.0, 1.03)
    video = torch.from_numpy(np.stack([image, cv2.warpAffine(image, turn, (96, 96), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)]))
    video = (video - video.min()) / (video.max() - video.min())
    y, x = np.mgrid[:96, :96]
    true = torch.from_numpy(
        np.stack([turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] - x, turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] - y], -1)
    )
    errors = [(optical_flow(video, method=method)[0] - true)[16:-16, 16:-16].norm(dim=-1).mean() for method in ("opencv", "parallel")]
    assert errors[1] < 1.2 * errors[0] and errors[1] < 0.1 * true[16:-16, 16:-16].norm(dim=-1).mean()


def test_brightness_is_the_weighted_mean_in_bytes():
    videos = torch.rand(2, 3, 20, 30, 3, generator=torch.Generator().manual_seed(0)) * 1.2 - 0.1  # also outside of what images hold
    with ThreadPoolExecutor(2) as pool:
        found = module._brightness(list(videos), pool)
    expected = (255 * (videos @ torch.tensor(module.GREY))).round().clamp(0, 255)
    assert found.dtype == torch.uint8 and (found.float() - expected).abs().max() <= 1
    assert (found.float() == expected).float().mean() > 0.999


def test_windows_of_several_videos_are_those_of_each():
    masks = torch.zeros(2, 5, 40, 40)
    masks[0, 2, 3:9, 5:12] = 1
    masks[1, 1, 20:30, 22:39] = 0.7
    assert module._windows(list(masks)) == [body_window(mask) for mask in masks]


def test_velocities_by_both_methods_agree(tmp_path):
    video = shifted((1.0, 0.5))[None]
    masks = torch.zeros(1, 4, 96, 96)
    masks[:, :, 20:70, 20:70] = 1
    arguments = (video, masks, torch.arange(4) * 0.01, orbit(1, width=96, height=96), torch.tensor([0.5, 0.4, 0.5]))
    one, other = (measure_velocities(*arguments, size=16, cache=tmp_path, method=method) for method in ("opencv", "parallel"))
    assert len(list(tmp_path.glob("flow-*.npz"))) == 2  # one is not taken for the other
    assert torch.equal(one.cell, other.cell)
    assert (one.flow - other.flow).norm() < 0.05 * one.flow.norm()


@pytest.mark.parametrize(
    ("images", "options", "word"),
    [
        (torch.zeros(1, 32, 32, 3), {}, "2 frames"),
        (torch.zeros(3, 8, 32, 3), {}, "16 pixels"),
        (torch.zeros(3, 32, 32, 3), {"preset": "best"}, "preset"),
        (torch.zeros(3, 32, 32, 3), {"method": "best"}, "method"),
    ],
)
def test_flow_refuses(images, options, word):
    with pytest.raises(UserError, match=word):
        optical_flow(images, **options)


def test_flow_image_keeps_the_magnitude_and_the_wheel_does_not():
    flow = torch.zeros(2, 16, 16, 2)
    flow[..., 0] = 0.5
    slow, fast = flow_image(flow, 2.0), flow_image(2 * flow, 2.0)
    assert torch.allclose(fast, 2 * slow)
    assert torch.allclose(slow[0, 0, 0], torch.tensor([0.25, 0.0, 0.25]))
    assert flow_image(100 * flow, 2.0).max() == 1
    assert torch.equal(colour_wheel(flow), colour_wheel(2 * flow))


def test_wheel_has_middleburys_colours():
    flow = torch.zeros(1, 1, 5, 2)
    flow[0, 0, :4] = torch.tensor([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    colours = (colour_wheel(flow)[0, 0] + 1) / 2
    right, left, down, up, still = colours
    assert torch.allclose(right, torch.tensor([1.0, 0.0, 0.0]), atol=1e-5)  # red
    assert left[2] > 0.9 and left[0] < 0.1  # blue-cyan
    assert down[0] > 0.9 and down[1] > 0.6 and down[2] < 0.1  # yellow
    assert up[0] > 0.3 and up[2] > 0.9 and up[1] < 0.1  # violet
    assert torch.allclose(still, torch.ones(3))


def test_window_holds_the_body_in_all_frames():
    masks = torch.zeros(2, 60, 80)
    masks[0, 10:20, 30:35] = 1
    masks[1, 30:38, 40:45] = 1
    top, left, side = body_window(masks)
    assert top <= 10 and top + side >= 38 and left <= 30 and left + side >= 45
    assert 28 < side < 40 and 0 <= top and top + side <= 60 and left + side <= 80
    assert body_window(torch.zeros(2, 60, 80)) == (0, 0, 60)


def test_pixel_length_and_velocity():
    cameras = orbit(2, radius=2.0, angle=40.0, width=100, height=100)
    length = pixel_length(cameras, torch.tensor([0.5, 0.4, 0.5]))
    assert length.tolist() == pytest.approx([2 * 2.0 * np.tan(np.radians(20)) / 100] * 2, rel=1e-5)
    with pytest.raises(UserError, match="behind"):
        pixel_length(cameras, torch.tensor([0.5, 0.4, 9.0]))

    video = shifted((2.0, 0.0)).expand(2, 4, 96, 96, 3)
    masks = torch.zeros(2, 4, 96, 96)
    masks[:, :, 20:70, 20:70] = 1
    small = orbit(2, radius=2.0, angle=40.0, width=96, height=96)
    seen = measure_velocities(video, masks, torch.arange(4) * 0.01, small, torch.tensor([0.5, 0.4, 0.5]), size=16)
    speed = 2.0 * pixel_length(small, torch.tensor([0.5, 0.4, 0.5]))[0] / 0.01
    assert seen.flow.shape == (2, 3, 16, 16, 2)
    assert float(seen.flow[:, :, 5:11, 5:11, 0].mean()) == pytest.approx(float(speed), rel=0.05)
    assert seen.flow[:, :, 0].abs().max() < 0.05 * speed  # beside the body
    assert float(seen.cell[0]) == pytest.approx(60 / 16 * float(speed) * 0.01 / 2, rel=1e-4)


def test_cache_is_used_and_mended(tmp_path, monkeypatch):
    video = shifted((1.0, 0.0))[None]
    arguments = (video, torch.ones(1, 4, 96, 96), torch.arange(4) * 0.01, orbit(1, width=96, height=96), torch.tensor([0.5, 0.4, 0.5]))
    first = measure_velocities(*arguments, size=16, cache=tmp_path)
    (file,) = tmp_path.glob("flow-*.npz")
    measured = []
    monkeypatch.setattr(module, "optical_flow", lambda images, **_: measured.append(1) or optical_flow(images))
    assert torch.equal(measure_velocities(*arguments, size=16, cache=tmp_path).flow, first.flow)
    assert not measured
    file.write_bytes(file.read_bytes()[:200])
    assert torch.equal(measure_velocities(*arguments, size=16, cache=tmp_path).flow, first.flow)
    assert measured
    measure_velocities(*arguments, size=24, cache=tmp_path)
    assert len(list(tmp_path.glob("flow-*.npz"))) == 2


def test_encoded_video_has_an_empty_first_frame():
    flow = torch.ones(2, 4, 16, 16, 2)
    video = encode_flow(flow, speed_scale=4.0)
    assert video.shape == (2, 3, 5, 16, 16)
    assert (video[:, :, 0] == 0).all() and (video[:, 0, 1:] == 0.25).all()
    with pytest.raises(UserError, match="encoding"):
        encode_flow(flow, encoding="rainbow")


def test_uneven_frames_are_refused():
    assert frame_interval_of([0.0, 0.1, 0.2]) == pytest.approx(0.1)
    with pytest.raises(UserError, match="evenly"):
        frame_interval_of([0.0, 0.1, 0.3])
