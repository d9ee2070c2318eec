"""Cameras: conversion between pose conventions, placement, projection and resizing.

| convention | axes of the camera | matrix |
| --- | --- | --- |
| OpenCV, COLMAP, gsplat, neuido | x right, y down, z forward | world to camera |
| OpenGL, Blender, Nerfstudio, NeuMA, PAC-NeRF | x right, y up, z backward | camera to world |

Conversions preserve double precision. `Cameras` holds float32, which renderers need.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from neuido.errors import UserError
from neuido.types import Cameras, Vector

SHEAR = 1e-2
"""Largest relative spread of singular values at which a matrix counts as a rounded or scaled rotation."""


def nearest_rotation(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Split a scaled rotation (..., 3, 3) into rotation (..., 3, 3) and scale (...), by polar decomposition.

    Files contain rounded rotations. NeuMA's BouncyBall contains rotations scaled by 0.41; the scale does not change the images.

    Raises:
        UserError: The matrix is sheared, singular or a reflection.
    """
    U, s, Vh = torch.linalg.svd(matrix)
    scale = s.mean(-1)
    if bool((s[..., 0] - s[..., 2] > SHEAR * scale).any() | (scale <= 0).any()):
        raise UserError(f"the rotation of the camera has the singular values {s.flatten()[:3].tolist()}; they must be equal")
    R = U @ Vh
    if bool((torch.linalg.det(R) < 0).any()):
        raise UserError("the rotation of the camera is a reflection (determinant -1): flip one axis of the matrix")
    return R, scale


def invert(pose: Tensor) -> Tensor:
    """Invert rigid transformations (..., 4, 4)."""
    R, t = pose[..., :3, :3], pose[..., :3, 3:]
    return _rigid(R.mT, -R.mT @ t)


def from_opengl(c2w: Tensor) -> Tensor:
    """Convert OpenGL camera-to-world matrices (..., 3 or 4, 4) to OpenCV world-to-camera matrices (..., 4, 4).

    Rotations are orthonormalised (`nearest_rotation`).

    Raises:
        UserError: A rotation is sheared, singular or a reflection.
    """
    R, _ = nearest_rotation(c2w[..., :3, :3])
    return invert(_rigid(R * R.new_tensor([1.0, -1.0, -1.0]), c2w[..., :3, 3:]))


def to_opengl(viewmats: Tensor) -> Tensor:
    """Convert OpenCV world-to-camera matrices (..., 4, 4) to OpenGL camera-to-world matrices (..., 4, 4)."""
    c2w = invert(viewmats)
    return _rigid(c2w[..., :3, :3] * c2w.new_tensor([1.0, -1.0, -1.0]), c2w[..., :3, 3:])


def from_quaternion(quaternion: Tensor, translation: Tensor) -> Tensor:
    """Convert COLMAP quaternions w, x, y, z (..., 4) and translations (..., 3) to world-to-camera matrices (..., 4, 4).

    Raises:
        UserError: A quaternion is zero.
    """
    length = torch.linalg.vector_norm(quaternion, dim=-1, keepdim=True)
    if bool((length < 1e-6).any()):
        raise UserError("the quaternion of the camera is zero")
    w, v = (quaternion / length).split([1, 3], dim=-1)
    X = _cross(v)
    eye = torch.eye(3, dtype=v.dtype, device=v.device)
    return _rigid(eye + 2 * (w[..., None] * X + X @ X), translation[..., None])


def to_quaternion(viewmats: Tensor) -> tuple[Tensor, Tensor]:
    """Convert world-to-camera matrices (..., 4, 4) to COLMAP quaternions w, x, y, z (..., 4), w >= 0, and translations (..., 3).

    The quaternion is the leading eigenvector of a symmetric 4 x 4 matrix (Bar-Itzhack 2000), which is well conditioned for every rotation.
    """
    R = viewmats[..., :3, :3]
    xx, xy, xz, yx, yy, yz, zx, zy, zz = R.flatten(-2).unbind(-1)
    rows = [
        torch.stack([xx + yy + zz, zy - yz, xz - zx, yx - xy], -1),
        torch.stack([zy - yz, xx - yy - zz, xy + yx, xz + zx], -1),
        torch.stack([xz - zx, xy + yx, yy - xx - zz, yz + zy], -1),
        torch.stack([yx - xy, xz + zx, yz + zy, zz - xx - yy], -1),
    ]
    q = torch.linalg.eigh(torch.stack(rows, -2)).eigenvectors[..., -1]
    return torch.where(q[..., :1] < 0, -q, q), viewmats[..., :3, 3]


def from_rodrigues(rotation: Tensor, translation: Tensor) -> Tensor:
    """Convert OpenCV rotation vectors `rvec` [rad] (..., 3) and translations `tvec` (..., 3) to world-to-camera matrices (..., 4, 4)."""
    return _rigid(torch.linalg.matrix_exp(_cross(rotation)), translation[..., None])


def intrinsics(width: int, height: int, *, focal: float | None = None, angle: float | None = None) -> Tensor:
    """Compute the intrinsic matrix K (3, 3), float64, of a camera whose principal point is the image centre.

    Args:
        width, height: Size of the image [px].
        focal: Focal length [px].
        angle: Horizontal angle of view [rad] (Blender's `camera_angle_x`), instead of `focal`.

    Raises:
        UserError: Neither or both of `focal` and `angle` are given, or the value is outside its range.
    """
    if (focal is None) == (angle is None):
        raise UserError("give either focal (px) or angle (rad)")
    if angle is not None:
        if not 0 < angle < math.pi:
            raise UserError(f"the horizontal angle of view must lie between 0 and pi rad, got {angle}")
        focal = 0.5 * width / math.tan(0.5 * angle)
    if not 0 < focal < math.inf:  # type: ignore[operator]
        raise UserError(f"the focal length must be positive, got {focal} px")
    return torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float64)


def look_at(eye: Vector, target: Vector, up: Vector = (0.0, 1.0, 0.0)) -> Tensor:
    """Return the world-to-camera matrix (4, 4), float64, of a camera that looks from `eye` at `target`.

    Args:
        eye: Position of the camera [m].
        target: Point at the image centre [m].
        up: Direction that points upwards in the image.

    Raises:
        UserError: `eye` equals `target`, or the viewing direction is parallel to `up`.
    """
    e, a, u = (torch.tensor(v, dtype=torch.float64) for v in (eye, target, up))
    forward = a - e
    right = torch.linalg.cross(forward, u)
    if torch.linalg.vector_norm(right) < 1e-9 * max(1.0, float(torch.linalg.vector_norm(forward) * torch.linalg.vector_norm(u))):
        raise UserError(f"a camera at {list(eye)} that looks at {list(target)} looks along up = {list(up)}: change one of them")
    forward, right = torch.nn.functional.normalize(torch.stack([forward, right]), dim=-1)
    R = torch.stack([right, torch.linalg.cross(forward, right), forward])
    return _rigid(R, -R @ e[:, None])


def orbit(
    view_count: int,
    *,
    target: Vector = (0.5, 0.4, 0.5),
    radius: float = 2.0,
    elevations: Sequence[float] = (20.0,),
    angle: float = 40.0,
    start: float = 0.0,
    width: int = 400,
    height: int = 400,
) -> Cameras:
    """Place cameras evenly around a target; +y is up.

    Args:
        view_count: Number of views.
        target: Point that the cameras look at [m].
        radius: Distance of the cameras from the target [m].
        elevations: Elevation angles above the horizon [degrees]; camera i has elevation i modulo their number.
        angle: Horizontal angle of view [degrees].
        start: Azimuth of the first view [degrees], from +z towards +x.
        width, height: Size of the images [px].

    Raises:
        UserError: `view_count`, `width` or `height` is below 1, `radius` is not positive, an elevation is not within 90 degrees, or `angle`
            is outside its range.
    """
    if view_count < 1 or width < 1 or height < 1:
        raise UserError(f"view_count, width and height must be at least 1, got {view_count}, {width}, {height}")
    if not radius > 0 or not elevations or any(not abs(e) < 90 for e in elevations):
        raise UserError(
            f"radius must be positive and elevations must lie between -90 and 90 degrees, got {radius} m and {list(elevations)}"
        )
    views = []
    for i in range(view_count):
        azimuth, elevation = math.radians(start + 360 * i / view_count), math.radians(elevations[i % len(elevations)])
        flat = radius * math.cos(elevation)
        offset = (flat * math.sin(azimuth), radius * math.sin(elevation), flat * math.cos(azimuth))
        views.append(look_at(tuple(t + o for t, o in zip(target, offset)), target))  # type: ignore[arg-type]
    K = intrinsics(width, height, angle=math.radians(angle))
    return Cameras(torch.stack(views).float(), K.float().expand(view_count, 3, 3).contiguous(), width, height)


def project(points: Tensor, cameras: Cameras) -> tuple[Tensor, Tensor]:
    """Project points [m] (N, 3) to pixels x, y (V, N, 2) and depths [m] (V, N); points at depth <= 0 are behind the camera.

    Of cameras that move choose a frame first (`Cameras.at`).
    """
    viewmats, Ks = cameras.viewmats.to(points.dtype), cameras.Ks.to(points.dtype)
    seen = points @ viewmats[:, :3, :3].mT + viewmats[:, None, :3, 3]
    image = seen @ Ks.mT
    return image[..., :2] / image[..., 2:], seen[..., 2]


def select(cameras: Cameras, views: Sequence[int]) -> Cameras:
    """Select cameras by index, in the given order."""
    chosen = torch.as_tensor(list(views), dtype=torch.long, device=cameras.viewmats.device)
    return cameras._replace(viewmats=cameras.viewmats[chosen], Ks=cameras.Ks[chosen])


def select_frames(cameras: Cameras, frames: Sequence[int]) -> Cameras:
    """Select the poses of frames, in the given order; fixed cameras stay as they are."""
    return cameras._replace(viewmats=cameras.viewmats[:, list(frames)]) if cameras.moving else cameras


def refuse_moving(cameras: Cameras, name: str, what: str) -> None:
    """Raise UserError if cameras move, where only fixed ones can be used.

    Args:
        cameras: The cameras.
        name: What has these cameras, for the message.
        what: What needs fixed cameras, and what to do instead.
    """
    if cameras.moving:
        raise UserError(f"{name} has cameras that move (a pose for each frame): {what}")


def resize(cameras: Cameras, width: int, height: int) -> Cameras:
    """Scale the intrinsics of cameras to another image size [px]; the poses do not change."""
    if width < 1 or height < 1:
        raise UserError(f"an image needs at least 1 pixel a side, got {width} x {height}")
    scale = cameras.Ks.new_tensor([width / cameras.width, height / cameras.height, 1.0])
    return Cameras(cameras.viewmats, cameras.Ks * scale[:, None], width, height)


def move(cameras: Cameras, *, scale: float = 1.0, rotation: Tensor | None = None, shift: Vector = (0.0, 0.0, 0.0)) -> Cameras:
    """Express cameras in transformed world coordinates x -> scale rotation x + shift.

    A transformed point has the same pixel in the returned camera as the original point in the given one. This takes cameras from the
    world coordinates of a recording to the simulation domain.

    Args:
        cameras: The cameras in the original world coordinates.
        scale: Scale factor [-].
        rotation: Rotation matrix (3, 3); None for the identity.
        shift: Translation [m].

    Raises:
        UserError: `scale` is not positive.
    """
    if not 0 < scale < math.inf:
        raise UserError(f"scale must be positive, got {scale}")
    old = cameras.viewmats.double()
    R = torch.eye(3, dtype=torch.float64, device=old.device) if rotation is None else rotation.to(old)
    turned = old[..., :3, :3] @ R.mT
    t = scale * old[..., :3, 3:] - turned @ old.new_tensor(shift)[:, None]
    return cameras._replace(viewmats=_rigid(turned, t).to(cameras.viewmats))


def _rigid(R: Tensor, t: Tensor) -> Tensor:
    """Assemble rigid transformations (..., 4, 4) from rotations (..., 3, 3) and translations (..., 3, 1)."""
    bottom = R.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*R.shape[:-2], 1, 4)
    return torch.cat([torch.cat([R, t], dim=-1), bottom], dim=-2)


def _cross(v: Tensor) -> Tensor:
    """Return the matrices (..., 3, 3) of the cross product with v (..., 3)."""
    x, y, z = v.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack([o, -z, y, z, o, -x, -y, x, o], dim=-1).unflatten(-1, (3, 3))
