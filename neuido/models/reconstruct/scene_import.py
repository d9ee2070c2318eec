"""Import scenes of MuJoCo, URDF, USD, PhysGaussian and Spring-Gaus, and Gaussians as a body."""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from neuido.data.bodies.mesh_files import TRIMESH_FORMATS, USD_FORMATS, read_mesh
from neuido.data.files.values import number
from neuido.data.neighbours.mjcf import read_mjcf
from neuido.data.neighbours.neighbour_scene import NeighbourScene, Placement, SoftBody
from neuido.data.neighbours.physgaussian import read_physgaussian
from neuido.data.neighbours.poses import upright
from neuido.data.neighbours.scene_folder import complete, write_scene
from neuido.data.neighbours.springgaus_config import read_springgaus
from neuido.data.neighbours.urdf import read_urdf
from neuido.data.neighbours.usd_scene import read_usd_scene
from neuido.data.neighbours.xml_elements import read_xml
from neuido.errors import UserError
from neuido.models.reconstruct.gaussian_body import filled_body, place_gaussians

OPACITY = 0.02
"""Opacity at or below which Gaussians are left out, as PhysGaussian does by default."""
PARTICLES = 4000
"""Approximate number of particles of a body."""


def import_scene(
    files: str | os.PathLike | Sequence[str | os.PathLike],
    out: str | os.PathLike | None,
    *,
    particles: int = PARTICLES,
    opacity_threshold: float | None = None,
    density: float | None = None,
    young: float | None = None,
    poisson: float | None = None,
    scale: float | None = None,
    up: str | None = None,
    region: Sequence[float] | None = None,
) -> list[str]:
    """Turn a scene of another program into a folder with `scene.yaml`, which `neuido simulate` runs.

    Args:
        files: A scene: MuJoCo's (.xml), a robot (.urdf), USD, PhysGaussian's (.json) or Spring-Gaus' (.yaml). After it, the body where the
            scene has none: a mesh, or Gaussians (3DGS .ply). A mesh or Gaussians alone are a scene too.
        out: The folder to create; None: the files are checked and nothing is written.
        particles: Approximate number of particles of a body.
        opacity_threshold: Opacity at or below which Gaussians are left out; by default what the scene says, else 0.02.
        density: [kg/m^3], in place of that of the scene.
        young: Young's modulus [Pa], in place of that of the scene.
        poisson: Poisson's ratio, in place of that of the scene.
        scale: Metres per unit of the body's file.
        up: The axis of the body's file that points up, x, y or z.
        region: The part of a file of Gaussians that is the body: smallest and largest x, y and z, in its units and axes.

    Returns:
        What was understood, and a line for each thing that has no counterpart.

    Raises:
        UserError: A file cannot be read, there is no body, or what is missing; the message names the option that gives it.
    """
    paths = [Path(file).expanduser() for file in ([files] if isinstance(files, str | os.PathLike) else files)]
    if not 1 <= len(paths) <= 2:
        raise UserError(f"a scene is one file, or two with its body; got {len(paths)}")
    if not isinstance(particles, int) or particles < 8:
        raise UserError(f"--particles {particles} must be a whole number of at least 8")
    for name, value in (("young", young), ("density", density), ("scale", scale)):
        if value is not None:
            number(value, f"--{name}", above=0.0)
    if out is not None and Path(out).expanduser().exists():
        raise UserError(f"--out {out} exists already: give another folder")
    scene, placement = _read(paths[0])
    body = paths[1] if len(paths) == 2 else paths[0] if scene is None else None
    if scene is None:
        scene = NeighbourScene(paths[0].stem, paths[0].name)
        scene.bodies.append(SoftBody(paths[0].stem, elasticity={"law": "neo_hookean"}))
        scene.walls = {"contact": "separate", "friction": 0.3, "inset": 2.0}
    elif body is not None and not scene.bodies:
        scene.bodies.append(SoftBody(body.stem, elasticity={"law": "neo_hookean"}))
    if body is not None:
        if len(paths) == 2 and any(own.mesh is not None for own in scene.bodies):
            raise UserError(f"{paths[0]} has bodies of its own: leave {body} out")
        _add_shape(scene, body, placement, particles, opacity_threshold, scale, up, region)
    complete(scene, density=density, young=young, poisson=poisson)
    return write_scene(scene, None if out is None else Path(out).expanduser(), particles=particles)


def _read(path: Path) -> tuple[NeighbourScene | None, Placement | None]:
    """Return the scene of a file, None for a mesh or Gaussians alone, and how it places Gaussians."""
    suffix = path.suffix.lower()
    if not path.is_file():
        raise UserError(f"{path} is missing" if not path.exists() else f"{path} is not a file")
    if suffix in (".xml", ".urdf"):
        return (read_urdf(path) if read_xml(path).tag == "robot" else read_mjcf(path)), None
    if suffix in USD_FORMATS:
        return read_usd_scene(path), None
    if suffix == ".json":
        return read_physgaussian(path)
    if suffix in (".yaml", ".yml"):
        return read_springgaus(path)
    if suffix in TRIMESH_FORMATS:
        return None, None
    known = (".xml", ".urdf", *USD_FORMATS, ".json", ".yaml", *TRIMESH_FORMATS)
    raise UserError(f"{path} is not a scene that is known: its name must end in {', '.join(known)}")


def _add_shape(
    scene: NeighbourScene,
    path: Path,
    placement: Placement | None,
    particles: int,
    opacity: float | None,
    scale: float | None,
    up: str | None,
    region: Sequence[float] | None,
) -> None:
    """Give the body of a scene its mesh, or the particles of its Gaussians."""
    own = scene.bodies[0]
    if not (path.suffix.lower() == ".ply" and _holds_gaussians(path)):
        if placement is not None:
            raise UserError(f"{path} must be the Gaussians of the scene, a 3DGS file (.ply)")
        if region is not None:
            raise UserError(f"--region cuts the body out of Gaussians, and {path} is a mesh")
        own.mesh = read_mesh(path, scale=scale, up=up)
        return
    placement = placement or Placement(upright(up or "y"))
    threshold = next(each for each in (opacity, placement.opacity, OPACITY) if each is not None)
    gaussians = place_gaussians(path, placement, opacity=threshold, scale=1.0 if scale is None else scale, region=_corners(region))
    own.particles = filled_body(gaussians, particles=particles)
    own.particles["v"] = np.tile(np.array(own.velocity, float), (len(own.particles["x"]), 1))
    shown = f"{len(gaussians.means)} Gaussians above the opacity threshold"
    scene.note("", f"{path.name}: {shown}, filled with {len(own.particles['x'])} particles")
    if scale is None and placement.length is None:
        extent = " x ".join(f"{float(side):.3g}" for side in gaussians.means.amax(0) - gaussians.means.amin(0))
        scene.note("", f"the units of {path.name} are taken as metres: the body is {extent} m; --scale says another")
    _keep_clamps(scene)


def _corners(region: Sequence[float] | None) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the lower and the upper corner of a region that is given as smallest and largest x, y and z."""
    if region is None:
        return None
    ends = np.array([number(value, "--region") for value in region])
    if len(ends) != 6 or not (ends[::2] < ends[1::2]).all():
        raise UserError(f"--region {list(region)} must be six numbers: smallest and largest x, y and z")
    return ends[::2], ends[1::2]


def _keep_clamps(scene: NeighbourScene) -> None:
    """Leave out clamps that hold no particle, which a scene file refuses."""
    x = scene.bodies[0].particles["x"]  # type: ignore[index]
    kept = [box for box in scene.clamps if ((x >= box[0]) & (x <= box[1])).all(axis=1).any()]
    for box in scene.clamps:
        if box not in kept:
            scene.note("", f"the box {[list(corner) for corner in box]} holds no particle and is left out")
    scene.clamps = kept


def _holds_gaussians(path: Path) -> bool:
    """Return whether the header of a PLY file has the columns of Gaussians, or of compressed ones."""
    with path.open("rb") as stream:
        head = stream.read(1 << 16).partition(b"end_header")[0]
    return (b" opacity" in head and b" f_dc_0" in head) or b" packed_position" in head
