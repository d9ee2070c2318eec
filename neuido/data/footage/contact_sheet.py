"""A contact sheet: frames of the videos with the outline that was found, as one PNG."""

from pathlib import Path

import cv2
import numpy as np

from neuido.data.files.writing import write_png

COLUMNS = 6
"""Frames of each video, evenly spread."""
WIDTH = 320
"""Width of a frame [px]."""
OUTLINE, INK = (0, 0, 255), (255, 255, 255)
"""Colours of the outline and of the text, BGR."""


class Sheet:
    """Collects frames; each video is a row."""

    def __init__(self) -> None:
        self.rows: dict[str, list[np.ndarray]] = {}

    def add(self, row: str, i: int, count: int, image: np.ndarray, mask: np.ndarray, text: str) -> None:
        """Add frame i of `count` with image (H, W, 3) RGB uint8 and mask (H, W), if it is one of those that are shown."""
        if i not in np.linspace(0, count - 1, COLUMNS).astype(int):
            return
        size = WIDTH, max(1, round(image.shape[0] * WIDTH / image.shape[1]))
        small = cv2.resize(cv2.cvtColor(image, cv2.COLOR_RGB2BGR), size, interpolation=cv2.INTER_AREA)
        shape = (cv2.resize(mask, size, interpolation=cv2.INTER_AREA) > 0.5).astype(np.uint8)
        outline, _ = cv2.findContours(shape, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(small, outline, -1, OUTLINE, 1)
        for colour, width in (((0, 0, 0), 3), (INK, 1)):
            cv2.putText(small, f"{row} {text}", (6, size[1] - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.4, colour, width, cv2.LINE_AA)
        self.rows.setdefault(row, []).append(small)

    def write(self, path: Path) -> None:
        """Write the sheet."""
        height = max(image.shape[0] for row in self.rows.values() for image in row)
        sheet = np.full((height * len(self.rows), WIDTH * COLUMNS, 3), 40, np.uint8)
        for r, row in enumerate(self.rows.values()):
            for c, image in enumerate(row[:COLUMNS]):
                sheet[r * height : r * height + image.shape[0], c * WIDTH : (c + 1) * WIDTH] = image
        write_png(path, sheet)
