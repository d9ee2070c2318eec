"""PAC-NeRF's data: `all_data.json` and `data/r_<camera>_<frame>.png`.

Frame -1 is the empty scene; frame -2, an occluder in front of the object, is left out (no elastic scene has one). The object's
mask is, in this order: the alpha of `a_<camera>_<frame>.png` (written by GIC), the alpha of the image, the difference to frame -1.
"""

import re
from pathlib import Path

from neuido.data.files.parsing import read_json
from neuido.data.files.values import inside, listed, number, take
from neuido.data.formats.layout import MultiView, Shot, assemble, calibration, opengl
from neuido.errors import UserError

NAME = re.compile(r"^(?:.*/)?r_([0-9]+)_(-?[0-9]+)\.png$")


def read(path: Path, *, recording: str | None = None, frame_interval: float | None = None) -> MultiView:
    """Read one scene's folder. GIC's held-out view, camera 0, is held out where GIC's `transforms_test.json` is there.

    Raises:
        UserError: A missing key or file, a name of another form, a view that lacks a frame.
    """
    shots = []
    backgrounds = {}
    frames: dict[str, set[int]] = {}
    for i, entry in enumerate(listed(read_json(path / "all_data.json"), str(path / "all_data.json"))):
        where = f"all_data.json[{i}]"
        given = take(entry, "file_path", where)
        image = inside(path, given, f"{where}.file_path")
        match = NAME.match(given)
        if match is None:
            raise UserError(f"{where}.file_path = {given!r} is not of the form data/r_<camera>_<frame>.png")
        view, frame = match[1], int(match[2])
        if frame == -1:
            backgrounds[view] = image
        if frame < 0:
            continue
        segmented = image.with_name(f"a_{view}_{frame}.png")
        viewmat = opengl(take(entry, "c2w", where), f"{where}.c2w")
        K = calibration(take(entry, "intrinsic", where), f"{where}.intrinsic")
        time = frame * frame_interval if frame_interval else number(take(entry, "time", where), f"{where}.time", least=0.0)
        shots.append(Shot(view, time, segmented if segmented.is_file() else image, viewmat, K))
        frames.setdefault(view, set()).add(frame)
    every = set().union(*frames.values()) if frames else set()
    for view, seen in frames.items():
        if seen != every:
            raise UserError(f"{path / 'all_data.json'}: camera {view} lacks frame {min(every - seen)}")
    missing = [picture for picture in backgrounds.values() if not picture.is_file()]
    if missing:
        raise UserError(f"the image {missing[0]} of the empty scene is missing; {path / 'all_data.json'} names it")
    shots.sort(key=lambda shot: int(shot.view))
    held_out = {"0"} if (path / "transforms_test.json").is_file() else set()
    return assemble(shots, folder=path, name=path.resolve().name, format="pacnerf", backgrounds=backgrounds, held_out=held_out)
