"""Read simulation scenes from YAML files of the format `neuido-scene/1`.

`configs/scenes` has the scenes of the literature. The keys `scene`, `model` and `discretisation` are those of an experiment file
(`neuido-experiment/1`), with `scene.walls` added. A scene file also has `name`, `source`, `body` and `steps`, or in place of `body` and
`model` a list `bodies`, each with its own, and `contact` between them.
"""

import inspect
import math
import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from types import NoneType
from typing import Any, NamedTuple, get_args

import numpy as np
import torch

from neuido.data.bodies import shapes
from neuido.data.bodies.collider_entries import solid_from_dict
from neuido.data.bodies.particle_volume import body_volume
from neuido.data.files.parsing import read_arrays, read_yaml
from neuido.data.files.values import check_keys, mapping, number, path_inside, vector
from neuido.data.files.yaml_files import checking
from neuido.errors import UserError, suggest
from neuido.physics.laws.classical import material
from neuido.physics.multibody.scene_bodies import CONTACTS as BODY_CONTACTS
from neuido.physics.runtime.limits import check_limit
from neuido.types import AttachedMass, Body, Box, Plane, Scene, Solid, Walls

FORMAT = "neuido-scene/1"
KEYS = ("format", "name", "source", "scene", "model", "body", "bodies", "contact", "discretisation", "steps", "on_inversion", "on_leave")
VARIABLE = "NEUIDO_DATA"
EFFECTS = ("viscosity_shear.eta", "viscosity_bulk.zeta", "rate_yield.eta", "rate_yield.index", "compaction_hardening.xi")
"""Effects that the model of a scene file may have: those that belong to the law of a fluid, of honey and of snow."""
CONTACTS = ("sticky", "slip", "separate")


class SceneSetup(NamedTuple):
    """The content of a scene file."""

    scene: Scene
    """The scene, with its bodies where the file lists several."""
    body: Body | None
    """The body; None where the file lists several."""
    info: dict[str, Any]
    """name, source, steps, on_inversion and on_leave. Of one body also density [kg/m^3], elasticity and plasticity (as
    `physics.laws.material` takes them) and `effects` (as `Effects.of` takes them), of several `models`, the first three of each."""


def data_root(option: str | os.PathLike | None = None) -> Path:
    """Return the data folder: `option`, or else the environment variable NEUIDO_DATA.

    Raises:
        UserError: Neither is given, or the folder does not exist.
    """
    given = option or os.environ.get(VARIABLE)
    if not given:
        raise UserError(f"this scene needs the data folder: give the option data_root or set the environment variable {VARIABLE}")
    root = Path(given).expanduser()
    if not root.is_dir():
        raise UserError(f"{'data_root' if option else VARIABLE} = {root} is not a folder")
    return root


def scene_names() -> list[str]:
    """List the names of the built-in scenes that `load_scene` reads.

    Lists for `neuido scenes`, which lie in configs/scenes too, are left out.
    """
    return sorted(path.stem for path in scenes_folder().glob("*.yaml") if f"\nformat: {FORMAT}\n" in path.read_text())


def load_scene(name: str | os.PathLike, root: str | os.PathLike | None = None) -> SceneSetup:
    """Read a simulation scene from `configs/scenes` or from a YAML file.

    A body that is read from a particle file has particles of equal volume: `body_volume` over their number.

    Args:
        name: Name of a built-in scene such as `bouncy-ball`, or a path that ends in .yaml.
        root: Data folder (`data_root`). Bodies that are made from shapes do not need it.

    Raises:
        UserError: The name or a key is unknown, a file is missing, a value is outside its physical range, or a path leaves the data folder.
    """
    path = Path(name) if str(name).endswith((".yaml", ".yml")) else scenes_folder() / f"{name}.yaml"
    if not path.is_file():
        known = "" if path.parent != scenes_folder() else f"{suggest(str(name), scene_names())}; known scenes: {', '.join(scene_names())}"
        raise UserError(f"the scene file {path} is missing{known}")
    content = read_yaml(path)
    with checking(path):
        one = "bodies" not in content
        given = [key for key in KEYS if key not in (("bodies", "contact") if one else ("model", "body"))]
        check_keys(content, "the file", given, ("source", "on_inversion", "on_leave", "contact"))
        if content["format"] != FORMAT:
            raise UserError(f"format = {content['format']!r} must be {FORMAT!r}")
        for key in ("name", "source"):
            if not isinstance(content.get(key, ""), str):
                raise UserError(f"{key} must be text, got {content[key]!r}")
        steps = content["steps"]
        if not isinstance(steps, int) or steps < 1:
            raise UserError(f"steps must be a positive whole number, got {steps!r}")
        on_inversion = content.get("on_inversion", "report")
        if on_inversion not in ("report", "error"):
            raise UserError(f"on_inversion must be report or error, got {on_inversion!r}")
        on_leave = content.get("on_leave", "error")
        if on_leave not in ("error", "clamp", "delete"):
            raise UserError(f"on_leave must be error, clamp or delete, got {on_leave!r}")
        scene = scene_from_dict(content["scene"], content["discretisation"], lambda file, where: named_file(file, where, root, path.parent))
        if one:
            own = mapping(content["model"], "model")
            effects = _effects(own.pop("effects", None))
            model = {**model_from_dict(own), "effects": effects}
            body = body_from_dict(content["body"], root, path.parent)
            _check_domain(body, scene)
        else:
            body, bodies, models = None, *_bodies(content["bodies"], scene, root, path.parent)
            scene = replace(scene, bodies=bodies, **_body_contact(content.get("contact"), [own.name for own in bodies]))
            model = {"models": models}
    info = {
        "name": content["name"],
        "source": content.get("source", ""),
        "steps": steps,
        "on_inversion": on_inversion,
        "on_leave": on_leave,
        **model,
    }
    return SceneSetup(scene, body, info)


def _check_domain(body: Body, scene: Scene) -> None:
    """Raise UserError where particles of a body lie outside the domain."""
    outside = ((body.x < torch.tensor(scene.lower)) | (body.x > torch.tensor(scene.upper))).any(dim=1)
    if outside.any():
        raise UserError(f"{int(outside.sum())} particles of the body lie outside scene.domain: enlarge the domain or move the body")


def _bodies(given: Any, scene: Scene, root: str | os.PathLike | None, beside: Path) -> tuple[tuple[Body, ...], list[dict[str, Any]]]:
    """Build the bodies of a scene file, each with its laws, and return their models too.

    Raises:
        UserError: As `load_scene`.
    """
    if not isinstance(given, list) or not given:
        raise UserError(f"bodies must be a list of at least one body, got {given!r}")
    check_limit(len(given), "NEUIDO_MAX_BODIES", f"bodies has {len(given)} entries")
    bodies, models = [], []
    for i, entry in enumerate(given):
        try:
            check_keys(mapping(entry, "an entry"), "an entry", ("name", "model", "body"))
            if not isinstance(entry["name"], str) or not entry["name"]:
                raise UserError(f"name must be text, got {entry['name']!r}")
            if entry["name"] in [body.name for body in bodies]:
                raise UserError(f"name = {entry['name']!r} is that of another body")
            model = model_from_dict(entry["model"])
            body = body_from_dict(entry["body"], root, beside)
            _check_domain(body, scene)
        except UserError as error:
            raise UserError(f"bodies[{i}]: {error}") from error
        law, plasticity = material(model["elasticity"], model["plasticity"])
        bodies.append(Body(shape=body, name=entry["name"], law=law, plasticity=plasticity, density=model["density"]))
        models.append({"name": entry["name"], **model})
    return tuple(bodies), models


def _body_contact(given: Any, names: list[str]) -> dict[str, Any]:
    """Return the contact between bodies as arguments of `Scene`.

    Args:
        given: `kind` (sticky or separate) and optionally `friction`: a coefficient, or a list of [name, name, coefficient].
        names: Names of the bodies.

    Raises:
        UserError: An unknown kind or name, or a coefficient that is negative.
    """
    if given is None:
        return {}
    given = mapping(given, "contact")
    check_keys(given, "contact", ("kind", "friction"), ("friction",))
    if given["kind"] not in BODY_CONTACTS:
        raise UserError(f"contact.kind = {given['kind']!r} is unknown: choose from {', '.join(BODY_CONTACTS)}")
    friction = given.get("friction", 0.0)
    if not isinstance(friction, list):
        return {"contact": given["kind"], "body_friction": number(friction, "contact.friction", least=0.0)}
    for i, pair in enumerate(friction):
        if not isinstance(pair, list) or len(pair) != 3 or any(name not in names for name in pair[:2]):
            raise UserError(f"contact.friction[{i}] must be [name, name, coefficient] of the bodies {', '.join(names)}, got {pair!r}")
        number(pair[2], f"contact.friction[{i}]", least=0.0)
    return {"contact": given["kind"], "body_friction": tuple(tuple(pair) for pair in friction)}


def scene_from_dict(scene: Mapping[str, Any], discretisation: Mapping[str, Any], find: Callable[[str, str], Path] | None = None) -> Scene:
    """Build a scene from the keys `scene` and `discretisation` of an experiment file.

    Args:
        scene: domain [m] and gravity [m/s^2]; optionally colliders, clamps, attached_masses and walls. walls has contact, friction and
            inset [cells]; null means no walls. Without the key, the faces of the domain are frictionless walls.
        discretisation: grid (cells along the longest side) and dt [s].
        find: Returns the path of a file that a collider names, from its text and the name of its key; None: colliders are planes alone.

    Raises:
        UserError: A key is unknown or missing, or a value has the wrong type or is outside its range. The message names the key.
    """
    optional = ("colliders", "clamps", "attached_masses", "walls")
    check_keys(scene, "scene", ("domain", "gravity", *optional), optional)
    check_keys(discretisation, "discretisation", ("grid", "dt"))
    domain = _box(scene["domain"], "scene.domain")
    cells = discretisation["grid"]
    if not isinstance(cells, int) or isinstance(cells, bool) or cells < 4:
        raise UserError(f"discretisation.grid must be a whole number of at least 4 cells, got {cells!r}")
    colliders = _list(scene, "colliders")
    check_limit(len(colliders), "NEUIDO_MAX_COLLIDERS", f"scene.colliders has {len(colliders)} entries")
    return Scene(
        lower=domain.lower,
        upper=domain.upper,
        cells=cells,
        dt=number(discretisation["dt"], "discretisation.dt", above=0.0),
        gravity=vector(scene["gravity"], "scene.gravity"),
        colliders=tuple(_collider(c, f"scene.colliders[{i}]", find) for i, c in enumerate(colliders)),
        walls=_walls(scene["walls"]) if "walls" in scene else Walls(),
        clamps=tuple(box_from_dict(c, f"scene.clamps[{i}]") for i, c in enumerate(_list(scene, "clamps"))),
        attached_masses=tuple(_attached(m, f"scene.attached_masses[{i}]") for i, m in enumerate(_list(scene, "attached_masses"))),
    )


def model_from_dict(model: Mapping[str, Any]) -> dict[str, Any]:
    """Validate the key `model` of an experiment file; return density [kg/m^3], elasticity and plasticity.

    Raises:
        UserError: A key is unknown or missing, or a parameter of the material is outside its physical range.
    """
    check_keys(model, "model", ("density", "elasticity", "plasticity"), ("plasticity",))
    density = number(model["density"], "model.density", above=0.0)
    elasticity = mapping(model["elasticity"], "model.elasticity")
    plasticity = mapping(model.get("plasticity", {"law": "identity"}), "model.plasticity")
    try:
        material(elasticity, plasticity)
    except UserError as error:
        raise UserError(f"model: {error}") from error
    return {"density": density, "elasticity": elasticity, "plasticity": plasticity}


def _effects(given: Any) -> dict[str, float]:
    """Return the effects beside the laws of a scene file by their names; empty without any."""
    given = mapping({} if given is None else given, "model.effects")
    for name in given:
        if name not in EFFECTS:
            raise UserError(f"model.effects.{name} is not known{suggest(str(name), EFFECTS) or ';'} choose from {', '.join(EFFECTS)}")
    return {name: number(value, f"model.effects.{name}", least=0.0) for name, value in given.items()}


def scenes_folder() -> Path:
    """Return the folder of the built-in scenes: `configs/scenes` of the checkout or of the installed package."""
    package = Path(__file__).resolve().parents[2]
    checkout = package.parent / "configs" / "scenes"
    return checkout if checkout.is_dir() else package / "configs" / "scenes"


def body_from_dict(given: Any, root: str | os.PathLike | None, folder: Path | None = None) -> Body:
    """Build a body from the key `body` of a scene file.

    Args:
        given: `shape` (cube, box, ball, cylinder or mesh) with the arguments of that function in `shapes`; or `particles`, the path of an
            .npz file with x, v and optionally volume. Paths are relative to the scene file, or else to the data folder.
        root: Data folder (`data_root`); used for paths alone.
        folder: Folder of the scene file.

    Raises:
        UserError: The shape, a key or a value is not accepted, or the particle file is missing or malformed.
    """
    given = mapping(given, "body")
    makers = {"cube": shapes.cube, "box": shapes.box, "ball": shapes.ball, "cylinder": shapes.cylinder, "mesh": shapes.mesh}
    if "shape" in given:
        options = {key: value for key, value in given.items() if key != "shape"}
        maker = makers.get(given["shape"]) if isinstance(given["shape"], str) else None
        if maker is None:
            close = suggest(str(given["shape"]), makers) or ":"
            raise UserError(f"body.shape = {given['shape']!r} is unknown{close} choose from {', '.join(makers)}")
        unknown = set(options) - set(maker.__kwdefaults__ or {}) - set(maker.__annotations__)
        if unknown:
            known = ("shape", *inspect.signature(maker).parameters)
            wrong = sorted(unknown)[0]
            raise UserError(f"unknown key {wrong!r} in body{suggest(str(wrong), known) or ';'} it takes {', '.join(known)}")
        for key, parameter in inspect.signature(maker).parameters.items():
            if key not in options and parameter.default is inspect.Parameter.empty:
                raise UserError(f"body lacks the key {key!r}, which a {given['shape']} needs")
            if key in options:
                options[key] = _shape_option(options[key], f"body.{key}", parameter.annotation)
        if "file" in options:
            options["file"] = named_file(options["file"], "body.file", root, folder)
        return maker(**options)
    check_keys(given, "body", ("particles",))
    return _particles(named_file(str(given["particles"]), "body.particles", root, folder))


def named_file(relative: str, where: str, root: str | os.PathLike | None, folder: Path | None = None) -> Path:
    """Return a file that a scene file names: beside the scene file, or else in the data folder.

    Args:
        relative: The path in the scene file.
        where: Name of the key in error messages.
        root: Data folder (`data_root`).
        folder: Folder of the scene file.

    Raises:
        UserError: The path leaves the folder, or neither folder has the file.
    """
    if folder is not None:
        beside = _inside(folder, relative, where)
        if isinstance(beside, Path) and beside.is_file():
            return beside
        if not root and not os.environ.get(VARIABLE):
            if isinstance(beside, UserError):
                raise beside
            raise UserError(f"{where}: the folder of the scene file, {folder}, has no file {relative}, and there is no data folder: set "
                            f"the option data_root or the environment variable {VARIABLE}")  # fmt: skip
    path = path_inside(data_root(root), relative, where, kind="data folder")
    if not path.is_file():
        raise UserError(f"{where}: the data folder {data_root(root)} has no file {relative}: check data_root or {VARIABLE}")
    return path


def _inside(folder: Path, relative: str, where: str) -> Path | UserError:
    """Return a path inside a folder, or the error of one that leaves it."""
    try:
        return path_inside(folder, relative, where, kind="folder of the scene file")
    except UserError as error:
        return error


def _shape_option(value: Any, where: str, kind: Any) -> Any:
    """Return an option of a shape, checked against the type that its function declares."""
    kinds = get_args(kind)
    if NoneType in kinds:
        if value is None:
            return None
        kind = next(each for each in kinds if each is not NoneType)
    if kinds and os.PathLike in kinds:
        kind = str
    if kind is bool:
        if not isinstance(value, bool):
            raise UserError(f"{where} must be true or false, got {value!r}")
        return value
    if kind is float:
        return number(value, where)
    if kind is int:
        if not isinstance(value, int) or isinstance(value, bool):
            raise UserError(f"{where} must be a whole number, got {value!r}")
        return value
    if kind is str:
        if not isinstance(value, str):
            raise UserError(f"{where} must be text, got {value!r}")
        return value
    return vector(value, where)


def _particles(path: Path) -> Body:
    try:
        arrays = read_arrays(path, ("x", "v"), ("volume",), what="archive with x and v")
    except UserError as error:
        raise UserError(f"body.particles: {error}") from error
    x, v = arrays["x"], arrays["v"]
    check_limit(len(x) if x.ndim else 0, "NEUIDO_MAX_PARTICLES", f"body.particles: {path} has {len(x) if x.ndim else 0} particles")
    if x.ndim != 2 or x.shape[1] != 3 or v.shape != x.shape:
        raise UserError(f"body.particles: {path} has x of shape {x.shape} and v of shape {v.shape}; both must be (P, 3)")
    if not (np.isfinite(x).all() and np.isfinite(v).all()):
        raise UserError(f"body.particles: {path} contains a NaN or an infinity")
    if not len(x):
        raise UserError(f"body.particles: {path} has no particles")
    if "volume" in arrays:
        volume = arrays["volume"]
        if volume.shape != x.shape[:1] or not (np.isfinite(volume) & (volume > 0)).all():
            raise UserError(f"body.particles: {path}: volume must be {len(x)} positive numbers")
        return Body(torch.from_numpy(x).float(), torch.from_numpy(v).float(), torch.from_numpy(volume).float())
    try:
        each = body_volume(x) / len(x)
    except UserError as error:
        raise UserError(f"body.particles: {path}: {error}") from error
    return Body(torch.from_numpy(x).float(), torch.from_numpy(v).float(), torch.full((len(x),), each))


def _collider(given: Any, where: str, find: Callable[[str, str], Path] | None) -> Plane | Solid:
    given = mapping(given, where)
    if given.get("kind") == "plane":
        given = {"type": "plane"} | {key: value for key, value in given.items() if key != "kind"}
    return solid_from_dict(given, where, find) if "kind" in given else _plane(given, where)


def _plane(given: Any, where: str) -> Plane:
    given = mapping(given, where)
    check_keys(given, where, ("type", "point", "normal", "contact", "friction"), ("friction",))
    if given["type"] != "plane":
        raise UserError(f"{where}.type = {given['type']!r} is unknown: it must be plane")
    normal = vector(given["normal"], f"{where}.normal")
    if not math.hypot(*normal) > 0:
        raise UserError(f"{where}.normal must not be zero")
    return Plane(vector(given["point"], f"{where}.point"), normal, *_contact(given, where))


def _walls(given: Any) -> Walls | None:
    if given is None:
        return None
    given = mapping(given, "scene.walls")
    check_keys(given, "scene.walls", ("contact", "friction", "inset"), ("friction", "inset"))
    return Walls(*_contact(given, "scene.walls"), inset=number(given.get("inset", 0.0), "scene.walls.inset", least=0.0))


def _contact(given: Mapping[str, Any], where: str) -> tuple[str, float]:
    if given["contact"] not in CONTACTS:
        raise UserError(f"{where}.contact = {given['contact']!r} is unknown: choose from {', '.join(CONTACTS)}")
    return given["contact"], number(given.get("friction", 0.0), f"{where}.friction", least=0.0, infinite=True)


def _attached(given: Any, where: str) -> AttachedMass:
    given = mapping(given, where)
    check_keys(given, where, ("box", "mass"))
    return AttachedMass(_box(given["box"], f"{where}.box"), number(given["mass"], f"{where}.mass", above=0.0))


def box_from_dict(given: Any, where: str) -> Box:
    """Read an entry whose one key is a `box`.

    Raises:
        UserError: Another key, or no box.
    """
    given = mapping(given, where)
    check_keys(given, where, ("box",))
    return _box(given["box"], f"{where}.box")


def _box(given: Any, where: str) -> Box:
    if not isinstance(given, list) or len(given) != 2:
        raise UserError(f"{where} must be [lower corner, upper corner], got {given!r}")
    lower, upper = (vector(corner, where) for corner in given)
    if any(u <= l for l, u in zip(lower, upper)):
        raise UserError(f"{where} needs lower < upper on each axis, got {given!r}")
    return Box(lower, upper)


def _list(scene: Mapping[str, Any], key: str) -> list[Any]:
    given = scene.get(key) or []
    if not isinstance(given, list):
        raise UserError(f"scene.{key} must be a list, got {given!r}")
    return given
