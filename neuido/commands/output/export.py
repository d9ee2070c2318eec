"""The `export` command: signature and help alone, so that `--help` loads no torch."""

from pathlib import Path
from typing import Any, Literal

from neuido.errors import UserError

Format = Literal["usd", "gltf", "vtk", "ply", "npz", "csv", "alembic", "abaqus", "ansys", "febio", "mujoco", "torchscript", "c"]
ENDINGS = {"usd": (".usd", ".usdc", ".usda"), "gltf": (".glb", ".gltf"), "vtk": (".pvd",), "ply": (".ply",), "npz": (".npz",),
           "csv": (".csv",), "alembic": (".abc",), "abaqus": (".inp",), "ansys": (".mac",), "febio": (".xml",), "mujoco": (".xml",),
           "torchscript": (".pt",), "c": (".h",)}  # fmt: skip
"""Endings of each format; the first is that of `out` where it has none."""
CARDS = ("abaqus", "ansys", "febio", "mujoco")
LEARNED = ("torchscript", "c")


def export_path(
    source: str,
    *,
    to: Format,
    out: str,
    recording: str | None = None,
    when: Literal["measured", "before", "after"] = "after",
    every: int = 1,
    frame_interval: float | None = None,
    law: str | None = None,
    surface: bool = False,
    surface_spacing: float | None = None,
    gaussians: str | None = None,
    cameras: str | None = None,
    speed: float = 1.0,
    units: Literal["si", "mm"] = "si",
    name: str = "neuido",
    tangent: bool = False,
    progress: bool = True,
) -> None:
    """Write a motion or a material law for other programs: `neuido export RUN --to usd --out motion.usd`.

    The motion goes to usd, gltf, vtk, ply, npz, csv or alembic. The constants of a classical law go to abaqus, ansys, febio or mujoco as a
    material card, those of a learned law to torchscript or c. docs/howto/export.md says what each format holds.

    Args:
        source: For a motion: folder of `neuido simulate`, `neuido predict` or `neuido diagnose`, or a file of frames (.npz). For a law:
            folder of `neuido diagnose` (its corrected model), an experiment, a material test or a scene file; a law.safetensors for a
            learned law.
        to: Format.
        out: File to write; it gets the ending of the format where it has none.
        recording: Recording of a diagnosis, or scene of a prediction, where there are several; the first where absent.
        when: Which motion of a diagnosis: measured, before or after the effects were added.
        every: Write every so many frames.
        frame_interval: Time between two frames, s, for a motion without times, as that of `neuido predict`.
        law: Scene or model file (.yaml), or law.safetensors, from whose elastic law the field `stress` is computed.
        surface: Reconstruct the surface of each body in each frame.
        surface_spacing: Distance between neighbouring particles of the surface, m; found in the first frame where absent.
        gaussians: 3DGS file (.ply) of the first frame, whose Gaussians move with the particles (usd, ply).
        cameras: Folder of a recording whose cameras are written too (usd, gltf).
        speed: Speed at which the motion plays (usd, gltf, alembic): 0.1 is ten times slower than it happened.
        units: Units of a material card: si (m, kg, s, Pa) or mm (mm, tonne, s, MPa).
        name: Name of the material, or prefix of the functions in C.
        tangent: Add the tangent to the functions in C, by central differences.
        progress: Show progress on stderr.

    Raises:
        UserError: Nothing to export, an option that the format has no place for, or a library that is not installed.
    """
    target = Path(out).expanduser()
    if not target.suffix:
        target = target.with_suffix(ENDINGS[to][0])
    if target.suffix.lower() not in ENDINGS[to]:
        raise UserError(f"out = {out}: the ending of {to} is {' or '.join(ENDINGS[to])}")
    motion_options = {
        "recording": recording, "when": when != "after", "every": every != 1, "frame_interval": frame_interval, "law": law,
        "surface": surface, "surface_spacing": surface_spacing, "gaussians": gaussians, "cameras": cameras, "speed": speed != 1.0,
    }  # fmt: skip
    law_options = {
        "units": units != "si" and to not in CARDS,
        "name": name != "neuido" and to not in (*CARDS, "c"),
        "tangent": tangent and to != "c",
    }
    is_law = to in (*CARDS, *LEARNED)
    for option, given in (motion_options if is_law else {}).items():
        if given:
            raise UserError(f"{option} is an option of motions, and --to {to} writes a law: leave it out")
    for option, given in law_options.items():
        if given:
            raise UserError(f"{option} is no option of --to {to}: leave it out")
    if to in CARDS:
        from neuido.export.materials.cards import write_card

        made = write_card(source, to, target, units=units, name=name)
    elif to == "torchscript":
        from neuido.export.materials.learned import write_torchscript

        made = write_torchscript(source, target)
    elif to == "c":
        from neuido.export.materials.c_header import write_c

        made = write_c(source, target, name=name, tangent=tangent)
    else:
        options = {"every": every, "surface": surface, "surface_spacing": surface_spacing, "speed": speed, "progress": progress}
        made = _motion(source, target, recording, when, frame_interval, law, gaussians, cameras, options)
    print(f"results in {made}")


def _motion(
    source: str,
    target: Path,
    recording: str | None,
    when: str,
    frame_interval: float | None,
    law: str | None,
    gaussians: str | None,
    cameras: str | None,
    options: dict[str, Any],
) -> Path:
    """Write a motion, and print what it was."""
    import neuido
    from neuido.export.runs import elastic_law, read_run

    run = read_run(source, recording=recording, when=when, frame_interval=frame_interval)
    chosen = run.laws if law is None else (elastic_law(Path(law)),)
    if target.suffix.lower() in (".npz", ".csv") and law is None:
        chosen = ()
    if gaussians is not None:
        from neuido.models.render.gaussians import load_gaussians

        options["gaussians"] = load_gaussians(gaussians, device="cpu")
    if cameras is not None:
        options["cameras"] = neuido.read_recording(cameras).cameras
    made = neuido.export(run.motion, target, law=chosen, scene=run.scene, **options)
    frames, count = run.motion.x.shape[:2]
    print(f"exported {run.what}: {frames} frames of {count} particles, {float(run.motion.times[-1]):.4g} s")
    for note in run.notes:
        print(f"note: {note}")
    return made
