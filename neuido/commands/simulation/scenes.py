"""The `scenes` command: simulated bodies, filmed from several views. `--help` loads no torch."""

from pathlib import Path
from typing import Any

from neuido.data.files.writing import check_writable
from neuido.data.scenes.film_options import Film


def scenes(
    out: str,
    *,
    scenes: list[dict[str, Any]],
    film: Film = Film(),  # noqa: B008 (frozen)
    data_root: str | None = None,
    device: str = "auto",
    progress: bool = True,
) -> None:
    """Simulate bodies of known material and film them from several views: recordings to learn from, with the truth beside.

    `neuido scenes --config six_small --out FOLDER` makes six small scenes without any data. Each becomes an experiment's folder with
    images, cameras, motion and law. A run that was interrupted goes on where it stopped when the same command is given again; on the
    CPU the files are equal byte for byte.

    Args:
        out: Folder to write: one folder a scene, plan.json at the start and index.json when all are there.
        scenes: Scenes to make, best in a file (--config); each has `name`, the keys of a scene file (or `base`, the name of
            one, with keys that differ), and any of `velocity`, `angular_velocity`, `shift`, `declared`, `split`, `substeps`.
        film: How they are filmed.
        data_root: Folder of the particles that scenes name; that of NEUIDO_DATA where absent.
        device: auto, cpu or cuda.
        progress: Show a progress bar.

    Raises:
        UserError: An impossible material or option, a step above the stability limit, a folder that holds other scenes.
    """
    check_writable(Path(out))
    from neuido.data.files.parsing import read_json
    from neuido.data.scenes.synthetic import make_scenes
    from neuido.models.render.splatting import rasterize

    make_scenes(scenes, film, out, draw=rasterize, data_root=data_root, device=device, progress=progress)
    for entry in read_json(Path(out) / "index.json")["scenes"]:
        laws = " and ".join(law["law"] for key, law in entry["law"].items() if key != "density" and law["law"] != "identity")
        print(f"{entry['name']}: {laws}, {entry['particles']} particles{' (unseen)' if entry['split'] == 'unseen' else ''}")
    print(f"{film.frames} frames of {film.width} x {film.height} px from {film.views} views, {len(set(film.held_out))} of them held out")
    print(f"results in {out}: one folder a scene, each with preview.png; `neuido reconstruct {out}/NAME` goes on")
