"""Reader of PAC-NeRF's data: `all_data.json` and `data/r_<camera>_<frame>.png`.

Frame -1 shows the empty scene. Frame -2 shows an occluder in front of the object and is skipped; no elastic scene has one. The mask of the
object is the first of these that exists: the alpha channel of `a_<camera>_<frame>.png` (written by GIC), the alpha channel of the image,
the difference from frame -1.
"""

import re
from pathlib import Path

from neuido.data.files.parsing import read_json
from neuido.data.files.values import list_of_mappings, number, path_inside, require_key
from neuido.data.formats.layout import MultiView, Shot, assemble, read_intrinsics, viewmat_from_opengl
from neuido.errors import UserError

NAME = re.compile(r"^(?:.*/)?r_([0-9]+)_(-?[0-9]+)\.png$")


def read(path: Path, *, recording: str | None = None, frame_interval: float | None = None) -> MultiView:
    """Read a scene of PAC-NeRF. Camera 0 is held out, as in GIC, if GIC's `transforms_test.json` exists.

    Args:
        path: The folder of the scene.
        recording: Not used.
        frame_interval: Time between frames [s]. It replaces the times of the file.

    Raises:
        UserError: A key or a file is missing, a file name is not `data/r_<camera>_<frame>.png`, or a camera lacks a frame of another one.
    """
    shots = []
    backgrounds = {}
    frames: dict[str, set[int]] = {}
    for i, entry in enumerate(list_of_mappings(read_json(path / "all_data.json"), str(path / "all_data.json"))):
        where = f"all_data.json[{i}]"
        given = require_key(entry, "file_path", where)
        image = path_inside(path, given, f"{where}.file_path")
        match = NAME.match(given)
        if match is None:
            raise UserError(f"{where}.file_path = {given!r} must have the form data/r_<camera>_<frame>.png")
        view, frame = match[1], int(match[2])
        if frame == -1:
            backgrounds[view] = image
        if frame < 0:
            continue
        segmented = image.with_name(f"a_{view}_{frame}.png")
        viewmat = viewmat_from_opengl(require_key(entry, "c2w", where), f"{where}.c2w")
        K = read_intrinsics(require_key(entry, "intrinsic", where), f"{where}.intrinsic")
        time = frame * frame_interval if frame_interval else number(require_key(entry, "time", where), f"{where}.time", least=0.0)
        shots.append(Shot(view, time, segmented if segmented.is_file() else image, viewmat, K))
        frames.setdefault(view, set()).add(frame)
    every = set().union(*frames.values()) if frames else set()
    for view, seen in frames.items():
        if seen != every:
            raise UserError(f"{path / 'all_data.json'}: camera {view} lacks frame {min(every - seen)}, which another camera has")
    missing = [picture for picture in backgrounds.values() if not picture.is_file()]
    if missing:
        raise UserError(f"the image {missing[0]} of the empty scene is missing; {path / 'all_data.json'} lists it")
    shots.sort(key=lambda shot: int(shot.view))
    held_out = {"0"} if (path / "transforms_test.json").is_file() else set()
    return assemble(shots, folder=path, name=path.resolve().name, format="pacnerf", backgrounds=backgrounds, held_out=held_out)
