"""Cameras of several views from a printed ChArUco board that all see, with OpenCV."""

import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np

from neuido.data.footage.filming import Filming, View, chosen_frames
from neuido.data.footage.video_frames import Clip, images
from neuido.errors import UserError

EXAMPLE = "7x5 40 mm 30 mm 4X4_50"
UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
LOOKS = 24
"""Frames of a clip that are searched for the board, evenly spread."""
MIN_CORNERS = 8
"""Corners that a frame must show; six determine a pose and a focal length, two more leave something to check."""
SAME_PLACE = 3.0
"""Largest mean distance of corners [px] between two frames in which the board has not moved."""
MANY_POSES = 5
"""Poses of the board from which on lens distortion and principal point are estimated too."""
MAX_RESIDUAL = 2.0
"""Root mean square of the distances of seen and projected corners [px] above which a calibration is refused."""
SURE = 0.02
"""Relative standard deviation of a focal length above which the summary says how to make it surer."""


class Board(NamedTuple):
    """A printed ChArUco board."""

    columns: int
    rows: int
    square: float
    """Side of a square [m]."""
    marker: float
    """Side of a marker [m]."""
    dictionary: str

    def opencv(self) -> Any:
        """Return OpenCV's board."""
        markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{self.dictionary}"))
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square, self.marker, markers)


def parse_board(text: str | None) -> Board:
    """Read the option `--board`, such as `7x5 40 mm 30 mm 4X4_50`.

    Raises:
        UserError: It is missing or malformed, the sizes are impossible, or OpenCV has no such dictionary.
    """
    form = f"--board {text!r} must have the form {EXAMPLE!r}: squares in x and y, side of a square, side of a marker, dictionary"
    length = r"([0-9]+(?:\.[0-9]+)?)\s*(mm|cm|m)"
    found = re.fullmatch(rf"\s*([0-9]{{1,2}})\s*x\s*([0-9]{{1,2}})\s+{length}\s+{length}\s+(?:DICT_)?(\w+)\s*", str(text or ""))
    if found is None:
        raise UserError(form)
    columns, rows = int(found[1]), int(found[2])
    square, marker = float(found[3]) * UNITS[found[4]], float(found[5]) * UNITS[found[6]]
    if min(columns, rows) < 2 or columns * rows < 9 or not 0 < marker < square or square > 10:
        raise UserError(f"{form}; markers are smaller than squares, and a board has at least 9 squares")
    names = sorted(name.removeprefix("DICT_") for name in dir(cv2.aruco) if name.startswith("DICT_"))
    if found[7].upper() not in (name.upper() for name in names):
        raise UserError(f"--board has the unknown dictionary {found[7]}: choose from {', '.join(names[:16])}")
    dictionary = next(name for name in names if name.upper() == found[7].upper())
    board = Board(columns, rows, square, marker, dictionary)
    there = len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{dictionary}")).bytesList)
    if columns * rows // 2 > there:
        raise UserError(f"--board {text!r} has {columns * rows // 2} markers, and the dictionary {dictionary} only {there}")
    return board


class Look(NamedTuple):
    """The corners that one frame shows."""

    frame: int
    ids: np.ndarray
    """(n,)"""
    corners: np.ndarray
    """(n, 2) [px], pixel centres at whole numbers."""


def board_cameras(clips: Sequence[Clip], filming: Filming) -> tuple[list[View], list[str]]:
    """Calibrate the camera of each clip; return them in the frame of the board, and lines for the summary.

    The frame of the board has x to the right, y up as printed and z out of the print, in metres. Its pose is that at the start of the
    motion. With few poses of the board, the lens is taken as free of distortion with its principal point at the centre.

    Raises:
        UserError: A clip does not show the board, or its corners fit no camera.
    """
    board = parse_board(filming.board)
    drawn = board.opencv()
    views, notes = [], []
    for clip in clips:
        looks = _looks(clip, drawn)
        if not looks:
            raise UserError(
                f"{clip.path} never shows {MIN_CORNERS} corners of the board ({filming.board}): is it flat, whole, sharp and printed with "
                "these numbers?"
            )
        view, note = _calibrated(clip, looks, board, drawn, int(chosen_frames(clip, filming)[0]))
        views.append(view)
        notes.append(note)
    return views, notes


def _looks(clip: Clip, drawn: Any) -> list[Look]:
    """Find the board in frames spread over a clip."""
    detector = cv2.aruco.CharucoDetector(drawn)
    chosen = np.unique(np.linspace(0, len(clip.times) - 1, LOOKS).astype(int))
    out = []
    for frame, image in zip(chosen, images(clip, chosen)):
        corners, ids, _, _ = detector.detectBoard(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
        if ids is None or len(ids) < MIN_CORNERS:
            continue
        points = drawn.getChessboardCorners()[ids.ravel()][:, :2]
        if min(np.ptp(points, axis=0)) > 0:  # corners on one line determine nothing
            out.append(Look(int(frame), ids.ravel(), corners.reshape(-1, 2).astype(np.float64)))
    return out


def _calibrated(clip: Clip, looks: list[Look], board: Board, drawn: Any, start: int) -> tuple[View, str]:
    poses: list[list[Look]] = []
    for look in looks:
        for group in poses:
            if _distance(group[0], look) < SAME_PLACE:
                group.append(look)
                break
        else:
            poses.append([look])
    means = [_median(group) for group in poses]
    solid = drawn.getChessboardCorners().astype(np.float32)
    size = (clip.width, clip.height)
    flags = cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3 | cv2.CALIB_USE_INTRINSIC_GUESS
    if len(means) < MANY_POSES:
        flags |= cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2
    guess = np.array([[max(size), 0, (size[0] - 1) / 2], [0, max(size), (size[1] - 1) / 2], [0, 0, 1]], float)
    try:
        error, K, lens, _, _, deviation, *_ = cv2.calibrateCameraExtended(
            [solid[look.ids] for look in means], [look.corners.astype(np.float32) for look in means], size, guess, np.zeros(5), flags=flags
        )
        at = min(range(len(poses)), key=lambda p: min(abs(look.frame - start) for look in poses[p]))
        done, turn, shift = cv2.solvePnP(solid[means[at].ids], means[at].corners, K, lens)
    except cv2.error as error:
        raise UserError(f"{clip.path}: the corners of the board fit no camera; film the board at a slant and close up") from error
    if not done or not np.isfinite(K).all() or not error < MAX_RESIDUAL:
        raise UserError(
            f"{clip.path}: seen and projected corners of the board differ by {error:.2g} px, more than {MAX_RESIDUAL:g}: is the board "
            f"flat, and printed as {board.columns}x{board.rows} with squares of {1e3 * board.square:g} mm?"
        )
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = cv2.Rodrigues(turn)[0] @ np.diag([1.0, -1.0, -1.0]), shift.ravel()
    K = K + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    spread = float(np.ravel(deviation)[:2].max() / K[0, 0])
    note = (f"{clip.path.name}: board seen in {len(looks)} frames, {len(poses)} pose{'s' * (len(poses) > 1)}; focal length "
            f"{K[0, 0]:.4g} px within {spread:.1%}, corners within {error:.2g} px")  # fmt: skip
    if spread > SURE:
        note += "; show the board close up and at several slants at the start of the clip to make it surer"
    return View(viewmat, K, tuple(np.ravel(lens)[:5].tolist())), note


def _distance(a: Look, b: Look) -> float:
    shared, i, j = np.intersect1d(a.ids, b.ids, return_indices=True)
    return float(np.linalg.norm(a.corners[i] - b.corners[j], axis=1).mean()) if len(shared) else np.inf


def _median(group: list[Look]) -> Look:
    """Return the median corners of frames in which the board has not moved; the object may have covered some."""
    ids = np.unique(np.concatenate([look.ids for look in group]))
    corners = [np.median([look.corners[look.ids == i][0] for look in group if i in look.ids], axis=0) for i in ids]
    return Look(group[0].frame, ids, np.array(corners))
