"""The `simulate` command: the motion of one scene file. `--help` loads no torch."""

import time
from pathlib import Path
from typing import Any, Literal

from neuido.data.files.output_folder import check_unused
from neuido.data.files.writing import copy_file, new_folder, write_text
from neuido.data.progress import Progress
from neuido.errors import UserError
from neuido.installation import configs_root
from neuido.physics.runtime.limits import check_limit

FRAMES = 100
"""Frames that are written at most where `every` is not given."""


def simulate(
    scene: str,
    *,
    out: str,
    law: str | None = None,
    steps: int | None = None,
    every: int | None = None,
    data_root: str | None = None,
    device: str = "auto",
    on_inversion: Literal["report", "error"] | None = None,
    on_leave: Literal["error", "clamp", "delete"] | None = None,
    progress: bool = True,
) -> None:
    """Simulate the bodies of a scene file and write their motion: `neuido simulate SCENE --out FOLDER`.

    Further simulations have commands of their own: `neuido trajectories` (training data of Stage I), `neuido scenes` (filmed bodies),
    `neuido undeclared` (a folder to diagnose, with a sealed answer) and `neuido replay` (the recordings of an experiment).

    Args:
        scene: Scene file, or the name of one that comes with neuido (bouncy-ball, nclaw-cube, ...).
        out: Folder to write, new or empty: frames.npz, a point cloud a frame in ply/, and the scene (and the learned law) beside them;
            forces.csv with the forces on solid colliders.
        law: Neural law of `neuido predict` (law.safetensors) in place of the scene's elasticity and plasticity, for all bodies.
        steps: Substeps; those of the scene file where absent.
        every: Write a frame every so many substeps, a divisor of `steps`; such that at most 100 frames follow the first where absent.
        data_root: Folder of the particles that a scene names; that of NEUIDO_DATA where absent.
        device: auto, cpu or cuda.
        on_inversion: Where matter turns inside out or collapses (det F below 0.001): report it, or end with an error and write nothing;
            what the scene file says where absent, else report.
        on_leave: Where a particle leaves the domain: end with an error, clamp it to the faces, or delete it; what the scene file says where
            absent, else error.
        progress: Show progress on stderr.

    Raises:
        UserError: An impossible scene or option, a folder that is in use, a step above the stability limit.
    """
    import torch

    from neuido.data.bodies.scene_files import load_scene
    from neuido.models.inference.law_file import load_law
    from neuido.physics.effects.parameters import Effects
    from neuido.physics.laws.classical import material
    from neuido.physics.mpm.simulator import Simulator

    folder = Path(out)
    check_unused(folder)
    setup = load_scene(_one_scene(scene), data_root)
    count = setup.info["steps"] if steps is None else steps
    if count < 1:
        raise UserError(f"steps is {count}; it must be a positive whole number")
    check_limit(count, "NEUIDO_MAX_STEPS", f"steps is {count}")
    spacing = next(k for k in range(-(-count // FRAMES), count + 1) if count % k == 0) if every is None else every
    models = setup.info.get("models") or [setup.info]
    laws: tuple = ()
    beside = {} if law is not None else setup.info.get("effects", {})
    effects = Effects.of(beside) if beside else None
    if law is not None:
        laws = load_law(law)
    elif setup.body is not None:
        laws = material(setup.info["elasticity"], setup.info["plasticity"])
    asked = on_inversion or setup.info["on_inversion"]
    leaves = on_leave or setup.info["on_leave"]
    density = models[0]["density"]
    simulator = Simulator(setup.scene, setup.body, density=density, device=device, on_inversion=asked, on_leave=leaves)
    start = time.perf_counter()
    with new_folder(folder) as hidden:
        with Progress(f"simulating {setup.info['name']}, {count} substeps in one run", shown=progress):
            frames = simulator.rollout(count, *laws, every=spacing, effects=effects)
        seconds = time.perf_counter() - start
        try:
            frames.save(hidden / "frames.npz")
            frames.save(hidden / "ply" / "frame.ply")
            copy_file(_file_of(scene), hidden / "scene.yaml")  # what `neuido view` needs for floor, gravity and stress
            if law is not None:
                copy_file(law, hidden / "law.safetensors")
            if frames.forces.shape[1]:
                write_text(hidden / "forces.csv", _force_table(frames))
        except OSError as error:
            raise UserError(f"out = {out}: {error.strerror or error}") from error
    print(
        f"simulated {setup.info['name']}: {frames.x.shape[1]} particles, {count} substeps of {setup.scene.dt:g} s, "
        f"{len(frames.x)} frames, on {simulator.device}, {seconds:.1f} s"
    )
    for model in models:
        told = f"the law of {law}" if law else ", ".join(_told(model[part]) for part in ("elasticity", "plasticity"))
        name = "" if setup.body is not None else f" of {model['name']}"
        told += "".join(f", {key} {value:g}" for key, value in beside.items())
        print(f"law{name}: {told}; density {model['density']:g} kg/m^3")
    fall, share = float(frames.x[-1, :, 1].mean() - frames.x[0, :, 1].mean()), torch.linalg.det(frames.F[-1].double())
    speed = float(frames.v[-1].norm(dim=1).max())
    print(
        f"after {float(frames.times[-1]):.4g} s: the centre is {abs(fall):.3g} m {'lower' if fall < 0 else 'higher'}, "
        f"the fastest particle has {speed:.3g} m/s, det F is {float(share.min()):.3g} to {float(share.max()):.3g}"
    )
    for solid in (collider for collider in frames.colliders if collider.force is not None):
        told_force = ", ".join(f"{value:.4g}" for value in solid.force[-1].tolist())
        print(f"mean force on {solid.name} in the last frame: ({told_force}) N")
    for event in frames.events:
        print(f"note: {event}")
    print(
        f"results in {folder}: frames.npz opens with numpy.load (x, v, C, F, times), "
        f"ply/frame_0000.ply and on in ParaView, MeshLab or Blender; `neuido view {folder}` plays them"
    )


def _force_table(frames: Any) -> str:
    """Return the forces on the solid colliders as a table, a row for each frame and collider."""
    rows = ["frame,time [s],collider,Fx [N],Fy [N],Fz [N],Tx [N m],Ty [N m],Tz [N m]"]
    solids = [collider for collider in frames.colliders if collider.force is not None]
    for k, time_of in enumerate(frames.times.tolist()):
        for solid in solids:
            figures = [*solid.force[k].tolist(), *solid.torque[k].tolist()]
            name = solid.name.replace('"', '""')
            rows.append(f'{k},{time_of:.9g},"{name}",' + ",".join(f"{value:.9g}" for value in figures))
    return "\n".join(rows) + "\n"


def _one_scene(scene: str) -> str:
    """Return a scene's file or name; a file that lists several scenes is an error that names the command for it."""
    from neuido.data.files.parsing import read_yaml

    own = _file_of(scene)
    if own.is_file() and "scenes" in read_yaml(own):
        raise UserError(f"{scene} lists several scenes to film: `neuido scenes --config {scene} --out FOLDER` makes them")
    return scene


def _file_of(scene: str) -> Path:
    """Return the file of a scene that is given by its path or its name."""
    return Path(scene) if scene.endswith((".yaml", ".yml")) else configs_root() / "scenes" / f"{scene}.yaml"


def _told(law: dict) -> str:
    """Return a law in words, such as `fixed_corotated (young 30000, poisson 0.2)`."""
    figures = ", ".join(f"{name} {value}" for name, value in law.items() if name != "law")
    return f"{law['law']} ({figures})" if figures else str(law["law"])
