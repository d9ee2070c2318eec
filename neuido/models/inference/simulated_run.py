"""The scene and the laws that lie beside the frames of `neuido simulate`. The files are not trusted."""

from pathlib import Path

from neuido.data.bodies.scene_files import model_from_dict, scene_from_dict
from neuido.data.files.parsing import naming, read_yaml
from neuido.data.formats.frame_files import LAW, SCENE
from neuido.models.inference.law_file import load_law
from neuido.physics.laws.base import ElasticLaw
from neuido.physics.laws.classical import material
from neuido.types import Scene


def scene_and_laws(folder: Path) -> tuple[Scene | None, tuple[ElasticLaw, ...]]:
    """Return the scene and the elastic law of each of its bodies; None and no laws where they are absent.

    Colliders other than planes are left out: the file of frames has their surfaces. A learned law is that of all bodies.

    Raises:
        UserError: A file that is damaged.
    """
    if not (folder / SCENE).is_file():
        return None, ()
    content = read_yaml(folder / SCENE)
    with naming(folder / SCENE):
        own = dict(content["scene"])
        own["colliders"] = [each for each in own.get("colliders") or [] if "plane" in (each.get("kind"), each.get("type"))]
        scene = scene_from_dict(own, content["discretisation"])
        if (folder / LAW).is_file():
            return scene, (load_law(folder / LAW)[0],)
        bodies = content.get("bodies") or [content]
        if not all("model" in each for each in bodies):
            return scene, ()
        models = [model_from_dict({key: value for key, value in each["model"].items() if key != "effects"}) for each in bodies]
        return scene, tuple(material(model["elasticity"], model["plasticity"])[0] for model in models)


def are_uniform(laws: tuple[ElasticLaw, ...]) -> bool:
    """Return whether no law varies within its body."""
    return all(len(tensor) == 1 for law in laws for tensor in law.tensors())
