"""neuido: differentiable mechanics, material laws from video, and the effects that a model lacks.

Importing the package imports neither torch nor lightning: every public name is imported at its first use.
"""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from neuido.data.bodies import shapes as shapes
    from neuido.data.bodies.scene_files import load_scene as load_scene
    from neuido.data.importers.importing import import_file as import_file
    from neuido.data.measured.experiment import read_experiment as read_experiment
    from neuido.data.measured.material_test import read_material_tests as read_material_tests
    from neuido.data.measured.track import read_tracks as read_tracks
    from neuido.data.scenes.readers import read as read_recording
    from neuido.discrepancy.own_effects import OwnEffect as OwnEffect
    from neuido.discrepancy.report.diagnosis import Diagnosis as Diagnosis
    from neuido.discrepancy.workflow import diagnose as diagnose
    from neuido.errors import UserError as UserError
    from neuido.export.exporting import export as export
    from neuido.models.inference.video_law import read_law as read_law
    from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator as Operator
    from neuido.models.reconstruct.scene_import import import_scene as import_scene
    from neuido.models.render.splatting import rasterize as rasterize
    from neuido.models.render.splatting import render as render
    from neuido.models.video.encoder import DynamicsEncoder as Encoder
    from neuido.physics import colliders as colliders
    from neuido.physics import effects as effects
    from neuido.physics import laws as laws
    from neuido.physics.fem.finite_elements import FiniteElements as FiniteElements
    from neuido.physics.mpm.simulator import Simulator as Simulator
    from neuido.physics.runtime.frames import Frames as Frames
    from neuido.types import AttachedMass as AttachedMass
    from neuido.types import Attachment as Attachment
    from neuido.types import Body as Body
    from neuido.types import Box as Box
    from neuido.types import Cameras as Cameras
    from neuido.types import Gaussians as Gaussians
    from neuido.types import Keyframes as Keyframes
    from neuido.types import ParticleState as ParticleState
    from neuido.types import Plane as Plane
    from neuido.types import Scene as Scene
    from neuido.types import Skin as Skin
    from neuido.types import Walls as Walls
    from neuido.viewer.opening import view as view

__version__ = "0.1.0"

_PLACES = {  # name: its module, and after a colon its name there; a module alone: the module itself
    **{
        name: f"types:{name}"
        for name in (
            "AttachedMass",
            "Attachment",
            "Body",
            "Box",
            "Cameras",
            "Gaussians",
            "Keyframes",
            "ParticleState",
            "Plane",
            "Scene",
            "Skin",
            "Walls",
        )
    },
    "Diagnosis": "discrepancy.report.diagnosis:Diagnosis",
    "Encoder": "models.video.encoder:DynamicsEncoder",
    "FiniteElements": "physics.fem.finite_elements:FiniteElements",
    "Frames": "physics.runtime.frames:Frames",
    "Operator": "models.operator.dynamics_operator:IntrinsicDynamicsOperator",
    "OwnEffect": "discrepancy.own_effects:OwnEffect",
    "Simulator": "physics.mpm.simulator:Simulator",
    "UserError": "errors:UserError",
    "diagnose": "discrepancy.workflow:diagnose",
    "colliders": "physics.colliders",
    "effects": "physics.effects",
    "export": "export",
    "import_file": "data.importers.importing:import_file",
    "import_scene": "models.reconstruct.scene_import:import_scene",
    "laws": "physics.laws",
    "load_scene": "data.bodies.scene_files:load_scene",
    "rasterize": "models.render.splatting:rasterize",
    "read_experiment": "data.measured.experiment:read_experiment",
    "read_law": "models.inference.video_law:read_law",
    "read_material_tests": "data.measured.material_test:read_material_tests",
    "read_recording": "data.scenes.readers:read",
    "read_tracks": "data.measured.track:read_tracks",
    "render": "models.render.splatting:render",
    "shapes": "data.bodies.shapes",
    "view": "viewer.opening:view",
}

__all__ = [
    "AttachedMass",
    "Attachment",
    "Body",
    "Box",
    "Cameras",
    "Diagnosis",
    "Encoder",
    "FiniteElements",
    "Frames",
    "Gaussians",
    "Keyframes",
    "Operator",
    "OwnEffect",
    "ParticleState",
    "Plane",
    "Scene",
    "Simulator",
    "Skin",
    "UserError",
    "Walls",
    "__version__",
    "colliders",
    "configs_root",
    "diagnose",
    "effects",
    "export",
    "import_file",
    "import_scene",
    "laws",
    "load_scene",
    "rasterize",
    "read_experiment",
    "read_law",
    "read_material_tests",
    "read_recording",
    "read_tracks",
    "render",
    "shapes",
    "view",
]


def configs_root() -> Path:
    """Return the folder of the configurations: beside the package in a checkout, inside it in a wheel."""
    package = Path(__file__).resolve().parent
    checkout = package.parent
    return checkout / "configs" if (checkout / "pyproject.toml").is_file() else package / "configs"


def __getattr__(name: str) -> Any:
    """Import a public name at its first use."""
    if name not in _PLACES:
        raise AttributeError(f"module 'neuido' has no attribute {name!r}")
    module, _, own = _PLACES[name].partition(":")
    found = import_module(f"neuido.{module}")
    value = globals()[name] = getattr(found, own) if own else found
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
