"""Inferred laws under other conditions: another velocity, another shape, two bodies in contact (paper, transfer).

A file of conditions, `neuido-conditions/1`:

    format: neuido-conditions/1
    name: thrown
    frames: 80               # optional; default: as in the recording of the first body
    bodies:                  # one or more bodies in the scene of the first one, each with its own law
      - of: 0                # number or name of the predicted scene that provides law, body and appearance
        velocity: [0.0, -3.0, 0.0]          # optional, replaces the recorded velocity [m/s]
        angular_velocity: [0.0, 0.0, 4.0]   # optional [rad/s]
        shift: [0.0, 0.1, 0.0]              # optional [m]
        shape: {shape: ball, ...}           # optional: another body, as `body` in a scene file
"""

import os
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch

from neuido.data.bodies import scene_files as scenes
from neuido.data.bodies.shapes import rigid_velocity
from neuido.data.files.parsing import read_yaml
from neuido.data.files.score_tables import folder_of
from neuido.data.files.values import check_keys, vector
from neuido.data.files.yaml_files import located
from neuido.errors import UserError
from neuido.models.inference.outputs import contact_sheet, write_particles, write_video
from neuido.models.inference.prepared_scene import Laws, PreparedScene
from neuido.models.render.gaussians import attach_gaussians, bind, colours_of, deform
from neuido.models.render.splatting import render
from neuido.physics.mpm.simulator import Simulator
from neuido.physics.runtime.frames import Frames
from neuido.types import Body, Gaussians, Vector

FORMAT = "neuido-conditions/1"
ZERO = (0.0, 0.0, 0.0)


class BodyCondition(NamedTuple):
    """One body of a condition."""

    of: int | str
    """Number or name of the predicted scene that provides law, body and appearance."""
    velocity: Vector | None = None
    angular_velocity: Vector = ZERO
    shift: Vector = ZERO
    shape: Body | None = None


class Condition(NamedTuple):
    """Content of a file of conditions."""

    name: str
    bodies: tuple[BodyCondition, ...]
    frames: int | None = None


def read_conditions(path: str | os.PathLike) -> Condition:
    """Read a file of conditions, given by its path or by its name in configs/conditions.

    Raises:
        UserError: The file is missing, or a key is unknown, missing or of the wrong type.
    """
    path = Path(path)
    if not path.is_file():
        own = scenes.scenes_folder().parent / "conditions" / f"{path.name.removesuffix('.yaml')}.yaml"
        if not own.is_file():
            raise UserError(f"condition_files: there is no file {path}, neither here nor in {own.parent}")
        path = own
    content = read_yaml(path)
    try:
        check_keys(content, "the file", ("format", "name", "frames", "bodies"), ("frames",))
        if content["format"] != FORMAT:
            raise UserError(f"format is {content['format']!r}, not {FORMAT!r}")
        frames = content.get("frames")
        if frames is not None and (not isinstance(frames, int) or frames < 2):
            raise UserError(f"frames must be a whole number of at least 2, got {frames!r}")
        given = content["bodies"]
        if not isinstance(given, list) or not given:
            raise UserError(f"bodies must be a list of at least one body, got {given!r}")
        bodies = tuple(_body(entry, f"bodies[{i}]") for i, entry in enumerate(given))
    except UserError as error:
        raise located(path, error) from error
    return Condition(str(content["name"]), bodies, frames)


def _body(entry: Any, where: str) -> BodyCondition:
    optional = ("velocity", "angular_velocity", "shift", "shape")
    check_keys(entry, where, ("of", *optional), optional)
    if isinstance(entry["of"], bool) or not isinstance(entry["of"], int | str):
        raise UserError(f"{where}.of must be the number or the name of a scene, got {entry['of']!r}")
    vectors = {key: vector(entry[key], f"{where}.{key}") for key in optional[:3] if key in entry}
    shape = scenes.body_from_dict(entry["shape"], None) if "shape" in entry else None
    return BodyCondition(entry["of"], **vectors, shape=shape)


def simulate_condition(condition: Condition, known: list[tuple[PreparedScene, Laws]]) -> tuple[Frames, Gaussians, PreparedScene]:
    """Simulate a condition.

    Args:
        condition: The condition.
        known: Predicted scenes with their laws.

    Returns:
        Motion of all particles, all Gaussians in each frame, and the scene that provides surroundings and cameras.

    Raises:
        UserError: A scene was not predicted, bodies overlap or leave the domain, or the rollout fails.
    """
    try:
        chosen = [_find(known, body.of) for body in condition.bodies]
        first = chosen[0][0]
        placed = [_place(body, prepared) for body, (prepared, _) in zip(condition.bodies, chosen)]
        _apart([body for body, _ in placed], first.source.scene.dx)
        device = first.images.device
        bodies = [
            Body(shape=body, law=laws[0], plasticity=laws[1], density=prepared.source.density)
            for (body, _), (prepared, laws) in zip(placed, chosen)
        ]
        simulator = Simulator(replace(first.source.scene, bodies=bodies, contact="sticky"), device=device)
        steps = ((condition.frames or first.frames) - 1) * first.stride
        with torch.no_grad():
            motion = simulator.rollout(steps, every=first.stride)
    except UserError as error:
        raise UserError(f"condition {condition.name}: {error}") from error
    parts, at = [], 0
    for body, gaussians in placed:
        own, at = slice(at, at + len(body.x)), at + len(body.x)
        binding = bind(gaussians, body.x.to(device))
        parts.append(deform(gaussians, motion.F[:, own], motion.x[:, own], binding))
    together = Gaussians(
        torch.cat([g.means for g in parts], 1),
        torch.cat([g.covariances for g in parts], 1),
        torch.cat([g.opacities for g in parts]),
        torch.cat([g.harmonics[:, :1] for g in parts]),
    )
    return motion, together, first


def run_condition(condition: Condition, known: list[tuple[PreparedScene, Laws]], out: str | os.PathLike) -> Path:
    """Simulate a condition, write its particles, video and contact sheet, and return their folder."""
    motion, gaussians, first = simulate_condition(condition, known)
    with torch.no_grad():
        images = render(gaussians, first.views([first.scoring_views[0]]).at(0), background=first.background)[0][:, 0]
    folder = folder_of(out, f"condition-{condition.name}")
    write_particles(folder / "particles", motion, motion.times)
    write_video(folder / "video.mp4", images)
    contact_sheet(folder / "video.png", [images])
    return folder


def _find(known: list[tuple[PreparedScene, Laws]], of: int | str) -> tuple[PreparedScene, Laws]:
    names = [prepared.source.name for prepared, _ in known]
    if isinstance(of, str):
        if of not in names:
            raise UserError(f"no scene {of!r} was predicted; there are {', '.join(names)}")
        return known[names.index(of)]
    if not 0 <= of < len(known):
        raise UserError(f"there is no scene number {of}; {len(known)} were predicted: {', '.join(names)}")
    return known[of]


def _place(body: BodyCondition, prepared: PreparedScene) -> tuple[Body, Gaussians]:
    """Place the body and its Gaussians at t = 0."""
    own, gaussians = prepared.source.body, prepared.gaussians
    if body.shape is not None:
        shape = body.shape
        spread = 0.6 * float(shape.volume.mean()) ** (1 / 3)
        # stripes in a dark and a light mean colour of the recorded body make the motion visible
        shades = colours_of(gaussians.harmonics, None, degree=0).cpu().clamp(0, 1)
        order = shades.mean(1).argsort()
        dark, light = shades[order[: len(order) // 2]].mean(0), shades[order[len(order) // 2 :]].mean(0)
        stripe = ((shape.x - shape.x.mean(0)) / (4 * spread)).floor().long().sum(1) % 2
        colours = torch.where(stripe[:, None] == 0, 0.8 * dark, light)
        like = gaussians.means
        coloured = attach_gaussians(shape.x, shape.volume, colours, spread=0.6)
        own, gaussians = shape, Gaussians(*(None if t is None else t.to(like) for t in coloured))
    shift = torch.tensor(body.shift, dtype=own.x.dtype)
    x, v = own.x + shift, own.v
    if body.velocity is not None or body.angular_velocity != ZERO:
        velocity = body.velocity if body.velocity is not None else tuple(own.v.mean(0).tolist())
        v = rigid_velocity(x, centre=tuple(x.mean(0).tolist()), velocity=velocity, angular_velocity=body.angular_velocity)
    return Body(x, v.to(x), own.volume), gaussians._replace(means=gaussians.means + shift.to(gaussians.means))


def _apart(bodies: list[Body], dx: float) -> None:
    """Check that bodies are at least half a cell apart; otherwise they would start as one body."""
    from scipy.spatial import KDTree

    for i in range(len(bodies)):
        for j in range(i):
            nearest = float(KDTree(bodies[i].x.numpy()).query(bodies[j].x.numpy())[0].min())
            if nearest < 0.5 * dx:
                raise UserError(f"bodies {j} and {i} start {nearest:.3g} m apart, less than half a cell of {dx:.3g} m; change their shift")
