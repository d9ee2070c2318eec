from .data import shapes
from .data.bodies.scene_files import load_scene
from .data.importers.importing import import_file
from .data.measured.experiment import read_experiment
from .data.measured.material_test import read_material_tests
from .data.measured.plane_experiment import read_plane_experiment
from .data.measured.track import read_tracks
from .data.scenes.readers import read_recording
from .discrepancy.own_effects import OwnEffect
from .discrepancy.report.diagnosis import Diagnosis
from .discrepancy.workflow import diagnose
from .errors import UserError
from .export.exporting import export
from .installation import __version__, configs_root
from .models.inference.video_law import read_law
from .models.operator.dynamics_operator import Operator
from .models.reconstruct.scene_import import import_scene
from .models.render.splatting import rasterize, render
from .models.video.encoder import Encoder
from .physics import colliders, effects, laws
from .physics.fem.finite_elements import FiniteElements
from .physics.mpm.simulator import Simulator
from .physics.runtime.frames import Frames
from .types import (
    AttachedMass,
    Attachment,
    Body,
    Box,
    Cameras,
    Gaussians,
    Keyframes,
    ParticleState,
    Plane,
    Scene,
    Skin,
    Walls,
)
from .viewer.notebook import show
from .viewer.opening import view

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
    "read_plane_experiment",
    "read_recording",
    "read_tracks",
    "render",
    "shapes",
    "show",
    "view",
]
