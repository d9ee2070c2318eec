"""Cameras in the conventions that people write down, as OpenCV world-to-camera matrices, and what is done with cameras.

| convention | axes of the camera | matrix |
| --- | --- | --- |
| OpenCV, COLMAP, gsplat; ours | x right, y down, z forward | world to camera |
| OpenGL, Blender, Nerfstudio, NeuMA, PAC-NeRF | x right, y up, z backward | camera to world |

Conversions keep double precision; `Cameras` holds float32, as renderers want it.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from neuido.errors import UserError
from neuido.types import Cameras, Vector

SHEAR = 1e-2
"""Relative spread of the singular values up to which a written rotation counts as one that was rounded or scaled."""


def nearest_rotation(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Return the rotation (..., 3, 3) and the scale (...) of a similarity, by the polar decomposition.

    Files carry rotations that are rounded, and NeuMA's BouncyBall ones that are scaled by 0.41; neither moves a projected point.

    Raises:
        UserError: The matrix is sheared, singular or a reflection.
    """
    U, s, Vh = torch.linalg.svd(matrix)
    scale = s.mean(-1)
    if bool((s[..., 0] - s[..., 2] > SHEAR * scale).any() | (scale <= 0).any()):
        raise UserError(f"the camera's rotation has singular values {s.flatten()[:3].tolist()}; those of a scaled rotation are equal")
    R = U @ Vh
    if bool((torch.linalg.det(R) < 0).any()):
        raise UserError("the camera's rotation is a reflection (determinant -1); flip one axis of its matrix")
    return R, scale


def invert(pose: Tensor) -> Tensor:
    """Return the inverse of rigid motions (..., 4, 4)."""
    R, t = pose[..., :3, :3], pose[..., :3, 3:]
    return _rigid(R.mT, -R.mT @ t)


def from_opengl(c2w: Tensor) -> Tensor:
    """Return OpenCV world-to-camera (..., 4, 4) of OpenGL camera-to-world (..., 3 or 4, 4), re-orthonormalised."""
    R, _ = nearest_rotation(c2w[..., :3, :3])
    return invert(_rigid(R * R.new_tensor([1.0, -1.0, -1.0]), c2w[..., :3, 3:]))


def to_opengl(viewmats: Tensor) -> Tensor:
    """Return OpenGL camera-to-world (..., 4, 4) of OpenCV world-to-camera (..., 4, 4)."""
    c2w = invert(viewmats)
    return _rigid(c2w[..., :3, :3] * c2w.new_tensor([1.0, -1.0, -1.0]), c2w[..., :3, 3:])


def from_quaternion(quaternion: Tensor, translation: Tensor) -> Tensor:
    """Return world-to-camera (..., 4, 4) of COLMAP's quaternion w, x, y, z (..., 4) and translation (..., 3)."""
    length = torch.linalg.vector_norm(quaternion, dim=-1, keepdim=True)
    if bool((length < 1e-6).any()):
        raise UserError("the camera's quaternion is zero")
    w, v = (quaternion / length).split([1, 3], dim=-1)
    X = _cross(v)
    eye = torch.eye(3, dtype=v.dtype, device=v.device)
    return _rigid(eye + 2 * (w[..., None] * X + X @ X), translation[..., None])


def to_quaternion(viewmats: Tensor) -> tuple[Tensor, Tensor]:
    """Return COLMAP's quaternion w, x, y, z with w >= 0 (..., 4) and translation (..., 3) of world-to-camera (..., 4, 4).

    The quaternion is the main eigenvector of a symmetric matrix (Bar-Itzhack 2000), which no rotation makes ill-conditioned.
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
    """Return world-to-camera (..., 4, 4) of OpenCV's rotation vector `rvec` [rad] (..., 3) and `tvec` (..., 3)."""
    return _rigid(torch.linalg.matrix_exp(_cross(rotation)), translation[..., None])


def intrinsics(width: int, height: int, *, focal: float | None = None, angle: float | None = None) -> Tensor:
    """Return K (3, 3), float64, of a camera with its principal point in the middle.

    Args:
        width, height: Size of the image [px].
        focal: Focal length [px].
        angle: Or the horizontal angle of view [rad], Blender's `camera_angle_x`.

    Raises:
        UserError: Neither or both are given, or one is out of range.
    """
    if (focal is None) == (angle is None):
        raise UserError("give either the focal length or the horizontal angle of view")
    if angle is not None:
        if not 0 < angle < math.pi:
            raise UserError(f"the horizontal angle of view must lie between 0 and pi, got {angle}")
        focal = 0.5 * width / math.tan(0.5 * angle)
    if not 0 < focal < math.inf:  # type: ignore[operator]
        raise UserError(f"the focal length must be positive, got {focal}")
    return torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float64)


def look_at(eye: Vector, target: Vector, up: Vector = (0.0, 1.0, 0.0)) -> Tensor:
    """Return world-to-camera (4, 4), float64, of a camera at `eye` that looks at `target` [m] with `up` upwards in its image.

    Raises:
        UserError: The camera sits at its target, or looks along `up`.
    """
    e, a, u = (torch.tensor(v, dtype=torch.float64) for v in (eye, target, up))
    forward = a - e
    right = torch.linalg.cross(forward, u)
    if torch.linalg.vector_norm(right) < 1e-9 * max(1.0, float(torch.linalg.vector_norm(forward) * torch.linalg.vector_norm(u))):
        raise UserError(f"a camera at {list(eye)} cannot look at {list(target)} with {list(up)} upwards")
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
    """Place cameras evenly around a target, +y up.

    Args:
        view_count: Number of views.
        target: What they look at [m].
        radius: Their distance from it [m].
        elevations: Their heights above the horizon [degrees], taken in turn.
        angle: Horizontal angle of view [degrees].
        start: Azimuth of the first view [degrees], from +z towards +x.
        width, height: Size of the images [px].

    Raises:
        UserError: No view, a radius that is not positive, an elevation of 90 degrees or more, an impossible angle.
    """
    if view_count < 1 or width < 1 or height < 1:
        raise UserError(f"view_count, width and height must be at least 1, got {view_count}, {width}, {height}")
    if not radius > 0 or not elevations or any(not abs(e) < 90 for e in elevations):
        raise UserError(f"radius must be positive and elevations within 90 degrees, got {radius} and {list(elevations)}")
    views = []
    for i in range(view_count):
        azimuth, elevation = math.radians(start + 360 * i / view_count), math.radians(elevations[i % len(elevations)])
        flat = radius * math.cos(elevation)
        offset = (flat * math.sin(azimuth), radius * math.sin(elevation), flat * math.cos(azimuth))
        views.append(look_at(tuple(t + o for t, o in zip(target, offset)), target))  # type: ignore[arg-type]
    K = intrinsics(width, height, angle=math.radians(angle))
    return Cameras(torch.stack(views).float(), K.float().expand(view_count, 3, 3).contiguous(), width, height)


def project(points: Tensor, cameras: Cameras) -> tuple[Tensor, Tensor]:
    """Return pixels x, y (V, N, 2) and depths [m] (V, N) of points [m] (N, 3); a point at depth <= 0 is not seen."""
    viewmats, Ks = cameras.viewmats.to(points.dtype), cameras.Ks.to(points.dtype)
    seen = points @ viewmats[:, :3, :3].mT + viewmats[:, None, :3, 3]
    image = seen @ Ks.mT
    return image[..., :2] / image[..., 2:], seen[..., 2]


def select(cameras: Cameras, views: Sequence[int]) -> Cameras:
    """Return the cameras of some views, in the order given."""
    chosen = torch.as_tensor(list(views), dtype=torch.long, device=cameras.viewmats.device)
    return cameras._replace(viewmats=cameras.viewmats[chosen], Ks=cameras.Ks[chosen])


def resize(cameras: Cameras, width: int, height: int) -> Cameras:
    """Return the same cameras with images of another size; the intrinsics are scaled with it."""
    if width < 1 or height < 1:
        raise UserError(f"an image needs at least 1 pixel a side, got {width} x {height}")
    scale = cameras.Ks.new_tensor([width / cameras.width, height / cameras.height, 1.0])
    return Cameras(cameras.viewmats, cameras.Ks * scale[:, None], width, height)


def move(cameras: Cameras, *, scale: float = 1.0, rotation: Tensor | None = None, shift: Vector = (0.0, 0.0, 0.0)) -> Cameras:
    """Return the same views of a world that is moved by x -> scale rotation x + shift: a point and its image stay together.

    NeuMA's and other recordings need it to get from the world in which they were filmed to the simulation's domain.
    """
    if not 0 < scale < math.inf:
        raise UserError(f"scale must be positive, got {scale}")
    old = cameras.viewmats.double()
    R = torch.eye(3, dtype=torch.float64, device=old.device) if rotation is None else rotation.to(old)
    turned = old[:, :3, :3] @ R.mT
    t = scale * old[:, :3, 3:] - turned @ old.new_tensor(shift)[:, None]
    return cameras._replace(viewmats=_rigid(turned, t).to(cameras.viewmats))


def _rigid(R: Tensor, t: Tensor) -> Tensor:
    """Return (..., 4, 4) of a rotation (..., 3, 3) and a translation (..., 3, 1)."""
    bottom = R.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*R.shape[:-2], 1, 4)
    return torch.cat([torch.cat([R, t], dim=-1), bottom], dim=-2)


def _cross(v: Tensor) -> Tensor:
    """Return the matrices (..., 3, 3) of v x, for v (..., 3)."""
    x, y, z = v.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack([o, -z, y, z, o, -x, -y, x, o], dim=-1).unflatten(-1, (3, 3))
