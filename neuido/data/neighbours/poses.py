"""Rotations as neighbours write them, as matrices that turn column vectors."""

import math
from collections.abc import Sequence

import numpy as np

from neuido.data.bodies.mesh_files import UP_AXES

Pose = tuple[np.ndarray, np.ndarray]
"""A position (3,) and the axes as columns (3, 3)."""


def from_quaternion(wxyz: Sequence[float]) -> np.ndarray:
    """Return the matrix of a quaternion (w, x, y, z) of any length but zero."""
    w, x, y, z = np.asarray(wxyz, float) / np.linalg.norm(wxyz)
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def to_quaternion(rotation: np.ndarray) -> tuple[float, float, float, float]:
    """Return the quaternion (w, x, y, z), with w >= 0, of a rotation matrix."""
    r = rotation
    squares = 1 + np.array(
        [r[0, 0] + r[1, 1] + r[2, 2], r[0, 0] - r[1, 1] - r[2, 2], r[1, 1] - r[0, 0] - r[2, 2], r[2, 2] - r[0, 0] - r[1, 1]]
    )
    largest = int(squares.argmax())
    rows = [
        [squares[0], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
        [r[2, 1] - r[1, 2], squares[1], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]],
        [r[0, 2] - r[2, 0], r[0, 1] + r[1, 0], squares[2], r[1, 2] + r[2, 1]],
        [r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], squares[3]],
    ]
    q = np.array(rows[largest]) / np.linalg.norm(rows[largest])
    w, x, y, z = (q if q[0] >= 0 else -q).tolist()
    return w, x, y, z


def about_axis(axis: int | Sequence[float], angle: float) -> np.ndarray:
    """Return the rotation by an angle [rad] about a coordinate axis (0, 1, 2) or about a vector."""
    n = np.eye(3)[axis] if isinstance(axis, int) else np.asarray(axis, float) / np.linalg.norm(axis)
    half = angle / 2
    return from_quaternion((math.cos(half), *(math.sin(half) * n)))


def from_euler(angles: Sequence[float], order: str) -> np.ndarray:
    """Return the rotation of Euler angles [rad]; lower-case letters turn about the turned axes, upper-case ones about the fixed axes."""
    rotation = np.eye(3)
    for letter, angle in zip(order, angles):
        own = about_axis("xyz".index(letter.lower()), angle)
        rotation = rotation @ own if letter.islower() else own @ rotation
    return rotation


def from_rpy(angles: Sequence[float]) -> np.ndarray:
    """Return the rotation of roll, pitch and yaw [rad] about the fixed axes x, y and z, as URDF has it."""
    return from_euler(angles, "XYZ")


def turn_between(start: Sequence[float], end: Sequence[float]) -> np.ndarray:
    """Return the smallest rotation that turns one direction into another."""
    a, b = (np.asarray(v, float) / np.linalg.norm(v) for v in (start, end))
    cosine, axis = float(a @ b), np.cross(a, b)
    if np.linalg.norm(axis) > 1e-9:
        return about_axis(axis.tolist(), math.atan2(float(np.linalg.norm(axis)), cosine))
    if cosine > 0:
        return np.eye(3)
    across = np.cross(a, np.eye(3)[int(np.abs(a).argmin())])
    return about_axis(across.tolist(), math.pi)


def upright(up: str) -> np.ndarray:
    """Return the rotation that turns an axis, x, y or z, to +y."""
    return np.array(UP_AXES[up])
