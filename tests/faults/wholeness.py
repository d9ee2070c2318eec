"""Whether a file of a result is whole, told by reading it to its end."""

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import torch
import yaml
from safetensors import safe_open

from neuido.data.formats.ply import read_ply_vertices


def not_whole(path: Path) -> str:
    """Return what is wrong with a file, or nothing; a folder, a link and a file of an unknown suffix are whole."""
    if path.is_symlink() or not path.is_file():
        return ""
    try:
        return _wrong(path)
    except Exception as error:
        return f"{type(error).__name__}: {str(error)[:100]}"


def _wrong(path: Path) -> str:
    if path.suffix == ".npz":
        with np.load(path) as arrays:
            for name in arrays.files:
                arrays[name]
    elif path.suffix == ".npy":
        np.load(path, mmap_mode="r")
    elif path.suffix == ".json":
        json.loads(path.read_text())
    elif path.suffix == ".yaml":
        yaml.compose(path.read_text(), yaml.SafeLoader)  # Lightning writes tuples with their tag
    elif path.suffix == ".ply":
        read_ply_vertices(path)
    elif path.suffix in (".png", ".jpg"):
        ended = path.read_bytes()[-8:-4] == b"IEND" if path.suffix == ".png" else path.read_bytes().endswith(b"\xff\xd9")
        return "" if cv2.imread(str(path), cv2.IMREAD_UNCHANGED) is not None and ended else "no image"
    elif path.suffix == ".mp4":
        film = cv2.VideoCapture(str(path))
        return "" if film.read()[0] else "no frame"
    elif path.suffix == ".html":
        return "" if path.read_text().rstrip().endswith("</html>") else "no end"
    elif path.suffix == ".csv":
        rows = list(csv.reader(path.read_text().splitlines()))
        return "" if len({len(row) for row in rows}) <= 1 and path.read_text().endswith("\n") else "rows of several lengths"
    elif path.suffix == ".safetensors":
        with safe_open(path, "pt") as file:
            for name in file.keys():
                file.get_tensor(name)
    elif path.suffix in (".ckpt", ".pt"):
        torch.load(path, weights_only=True, map_location="cpu")
    return ""
