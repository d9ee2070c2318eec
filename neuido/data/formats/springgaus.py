"""Reader of Spring-Gaus's data: `mpm_synthetic/<object>` and `real_capture`.

```
<object>/camera.json, <object>/<camera>/000.png ...                  mpm_synthetic, RGBA
static/{images,masks,colmap}/<object>/...                            real_capture, stills of the object at rest
dynamic/cameras_calib.json, dynamic/sequences/<object>/<n>.json      real_capture, videos
dynamic/{videos_images/<camera>/*.jpg,videos_masks/<camera>/*.png}
```
"""

from pathlib import Path

from neuido.data.files.parsing import image_size, read_json
from neuido.data.files.values import list_of_mappings, path_inside, require_key
from neuido.data.formats import colmap
from neuido.data.formats.layout import MultiView, Shot, assemble, natural_key, read_intrinsics, viewmat_from_opengl
from neuido.data.formats.neuma import dynamic_lens, extrinsics
from neuido.errors import UserError

SYNTHETIC_INTERVAL = 0.03
"""Time between frames [s] of mpm_synthetic (`DT` in Spring-Gaus's configurations)."""
REAL_INTERVAL = 1 / 120
"""Time between frames [s] of real_capture (`FREQ` in Spring-Gaus's configurations)."""


def read(path: Path, *, recording: str | None = None, frame_interval: float | None = None) -> MultiView:
    """Read an object of mpm_synthetic or a sequence of real_capture.

    Args:
        path: The folder `mpm_synthetic/<object>`, or the folder `real_capture`.
        recording: `<object>/<sequence>` of real_capture, for example `bun/0`. Needed if there are several.
        frame_interval: Time between frames [s]. Default: 0.03 s (mpm_synthetic), 1/120 s (real_capture).

    Raises:
        UserError: A key or a file is missing, the sequence is unknown, or a camera lacks a frame of another one.
    """
    if (path / "camera.json").is_file():
        return _synthetic(path, frame_interval or SYNTHETIC_INTERVAL)
    return _real(path, recording, frame_interval or REAL_INTERVAL)


def read_static(path: Path, name: str) -> MultiView:
    """Read the still images of an object of real_capture.

    Cameras are in COLMAP's own frame and scale; the object has to be registered to the video.

    Args:
        path: The folder `real_capture`.
        name: Name of the object.

    Raises:
        UserError: The object has no COLMAP model, or an image is missing.
    """
    static = path / "static"
    model = path_inside(static, f"colmap/{name}", "the object's name")
    return colmap.views(model, static / "images" / name, folder=path, name=name, masks=static / "masks" / name)


def _synthetic(path: Path, interval: float) -> MultiView:
    shots = []
    for i, entry in enumerate(list_of_mappings(read_json(path / "camera.json"), str(path / "camera.json"))):
        where = f"camera.json[{i}]"
        name = require_key(entry, "camera", where)
        folder = path_inside(path, name, f"{where}.camera")
        viewmat = viewmat_from_opengl(require_key(entry, "c2w", where), f"{where}.c2w")
        K = read_intrinsics(require_key(entry, "K", where), f"{where}.K")
        frames = sorted((file for file in folder.glob("*.png") if file.stem.isdigit()), key=lambda file: int(file.stem))
        if not frames:
            raise UserError(f"{where}: {folder} contains no frames 000.png, 001.png, ...")
        shots += [Shot(name, int(file.stem) * interval, file, viewmat, K) for file in frames]
    return _whole(assemble(shots, folder=path, name=path.resolve().name, format="springgaus"))


def _real(path: Path, recording: str | None, interval: float) -> MultiView:
    dynamic = path / "dynamic"
    name = _sequence(dynamic, recording)
    content = read_json(path_inside(dynamic / "sequences", f"{name}.json", "recording"))
    calibrated = read_json(dynamic / "cameras_calib.json")
    if not isinstance(calibrated, dict) or not isinstance(content, dict):
        raise UserError(f"{dynamic}: cameras_calib.json and sequences/{name}.json must be mappings")
    views = {key: value for key, value in content.items() if key != "hit_frame"}
    if not views or not all(isinstance(value, list) and value for value in views.values()):
        raise UserError(f"{dynamic}/sequences/{name}.json must list the images of each camera")
    static = path / "static" / "colmap" / name.split("/")[0] / "cameras.bin"
    lens = next(iter(colmap.read_cameras(static).values()))
    shots = []
    K, size = None, (1, 1)
    for view in sorted(views, key=natural_key):
        viewmat = extrinsics(calibrated, view, dynamic / "cameras_calib.json")
        pictures, masks = (path_inside(dynamic, f"{kind}/{view}", "camera") for kind in ("videos_images", "videos_masks"))
        for t, given in enumerate(views[view]):
            image = path_inside(pictures, given, f"sequences/{name}.json: {view}[{t}]")
            if K is None:
                size = image_size(image)
                K = dynamic_lens(lens, size)
            mask = (masks / image.relative_to(pictures)).with_suffix(".png")
            shots.append(Shot(view, t * interval, image, viewmat, K, mask))
    return _whole(assemble(shots, size=size, folder=path, name=name.replace("/", "-"), format="springgaus"))


def _sequence(dynamic: Path, recording: str | None) -> str:
    known = sorted(str(file.relative_to(dynamic / "sequences").with_suffix("")) for file in (dynamic / "sequences").glob("*/*.json"))
    if recording is None and len(known) == 1:
        return known[0]
    if recording not in known:
        raise UserError(f"recording = {recording!r} is not in {dynamic / 'sequences'}: choose from {', '.join(known) or '(none found)'}")
    return recording


def _whole(found: MultiView) -> MultiView:
    for view, row in zip(found.views, found.images):
        if None in row:
            raise UserError(f"{found.folder}: camera {view} lacks frame {row.index(None)} of {len(row)}, which another camera has")
    return found
