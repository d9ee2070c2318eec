"""Spring-Gaus's data: `mpm_synthetic/<object>` and `real_capture`.

```
<object>/camera.json, <object>/<camera>/000.png ...                  mpm_synthetic, RGBA
static/{images,masks,colmap}/<object>/...                            real_capture, stills of the object at rest
dynamic/cameras_calib.json, dynamic/sequences/<object>/<n>.json      real_capture, videos
dynamic/{videos_images/<camera>/*.jpg,videos_masks/<camera>/*.png}
```
"""

from pathlib import Path

from neuido.data.files.parsing import image_size, read_json
from neuido.data.files.values import inside, listed, take
from neuido.data.formats import colmap
from neuido.data.formats.layout import MultiView, Shot, assemble, calibration, natural, opengl
from neuido.data.formats.neuma import dynamic_lens, extrinsics
from neuido.errors import UserError

SYNTHETIC_INTERVAL = 0.03
"""Seconds a frame of mpm_synthetic (`DT` in its configurations)."""
REAL_INTERVAL = 1 / 120
"""Seconds a frame of real_capture (`FREQ` in its configurations)."""


def read(path: Path, *, recording: str | None = None, frame_interval: float | None = None) -> MultiView:
    """Read an object of mpm_synthetic, or a sequence of real_capture.

    Args:
        path: `mpm_synthetic/<object>` or the folder `real_capture` with `static` and `dynamic`.
        recording: `<object>/<sequence>` of real_capture, say `bun/0`; needed where there are several.
        frame_interval: Default: 0.03 s (synthetic) and 1/120 s (real).

    Raises:
        UserError: A missing key or file, an unknown sequence, cameras with unequal numbers of frames.
    """
    if (path / "camera.json").is_file():
        return _synthetic(path, frame_interval or SYNTHETIC_INTERVAL)
    return _real(path, recording, frame_interval or REAL_INTERVAL)


def read_static(path: Path, name: str) -> MultiView:
    """Return the stills of an object of real_capture, in COLMAP's own frame and scale: the object has to be registered to the video."""
    static = path / "static"
    model = inside(static, f"colmap/{name}", "the object's name")
    return colmap.views(model, static / "images" / name, folder=path, name=name, masks=static / "masks" / name)


def _synthetic(path: Path, interval: float) -> MultiView:
    shots = []
    for i, entry in enumerate(listed(read_json(path / "camera.json"), str(path / "camera.json"))):
        where = f"camera.json[{i}]"
        name = take(entry, "camera", where)
        folder = inside(path, name, f"{where}.camera")
        viewmat = opengl(take(entry, "c2w", where), f"{where}.c2w")
        K = calibration(take(entry, "K", where), f"{where}.K")
        frames = sorted((file for file in folder.glob("*.png") if file.stem.isdigit()), key=lambda file: int(file.stem))
        if not frames:
            raise UserError(f"{where}: {folder} holds no frame 000.png, 001.png, ...")
        shots += [Shot(name, int(file.stem) * interval, file, viewmat, K) for file in frames]
    return _whole(assemble(shots, folder=path, name=path.resolve().name, format="springgaus"))


def _real(path: Path, recording: str | None, interval: float) -> MultiView:
    dynamic = path / "dynamic"
    name = _sequence(dynamic, recording)
    content = read_json(inside(dynamic / "sequences", f"{name}.json", "recording"))
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
    for view in sorted(views, key=natural):
        viewmat = extrinsics(calibrated, view, dynamic / "cameras_calib.json")
        pictures, masks = (inside(dynamic, f"{kind}/{view}", "camera") for kind in ("videos_images", "videos_masks"))
        for t, given in enumerate(views[view]):
            image = inside(pictures, given, f"sequences/{name}.json: {view}[{t}]")
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
        raise UserError(f"recording = {recording!r} is not in {dynamic / 'sequences'}; one of {', '.join(known) or '(none there)'}")
    return recording


def _whole(found: MultiView) -> MultiView:
    for view, row in zip(found.views, found.images):
        if None in row:
            raise UserError(f"{found.folder}: camera {view} lacks frame {row.index(None)} of {len(row)}, which another camera has")
    return found
