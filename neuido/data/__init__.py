"""Data: multi-view recordings, experiments, material tests, tracks, simulation scenes and bodies.

The names of `__all__` are imported on first use, so `import neuido.data` does not load torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from neuido.data import cameras
    from neuido.data.bodies import shapes
    from neuido.data.bodies.collider_entries import mesh_collider
    from neuido.data.bodies.scene_files import SceneSetup, load_scene, scene_names
    from neuido.data.bodies.skinning import bind_skin
    from neuido.data.clips import FilmDataModule
    from neuido.data.formats.layout import MultiView
    from neuido.data.measured.experiment import Experiment, Recording, read_experiment, write_experiment
    from neuido.data.measured.material_test import MaterialTest, MaterialTests, read_material_tests
    from neuido.data.measured.track import Track, Tracks, read_tracks
    from neuido.data.scenes.filmed_scene_module import VisualDataModule
    from neuido.data.scenes.multiview import MultiViewDataModule
    from neuido.data.scenes.readers import read as read_recording
    from neuido.data.trajectories.trajectory_module import TrajectoryDataModule

__all__ = [
    "Experiment",
    "FilmDataModule",
    "MaterialTest",
    "MaterialTests",
    "MultiView",
    "MultiViewDataModule",
    "Recording",
    "SceneSetup",
    "Track",
    "Tracks",
    "TrajectoryDataModule",
    "VisualDataModule",
    "bind_skin",
    "cameras",
    "load_scene",
    "mesh_collider",
    "read_experiment",
    "read_material_tests",
    "read_recording",
    "read_tracks",
    "scene_names",
    "shapes",
    "write_experiment",
]

_PLACES = {
    "Experiment": "measured.experiment",
    "FilmDataModule": "clips",
    "MaterialTest": "measured.material_test",
    "MaterialTests": "measured.material_test",
    "MultiView": "formats.layout",
    "MultiViewDataModule": "scenes.multiview",
    "Recording": "measured.experiment",
    "SceneSetup": "bodies.scene_files",
    "Track": "measured.track",
    "Tracks": "measured.track",
    "TrajectoryDataModule": "trajectories.trajectory_module",
    "VisualDataModule": "scenes.filmed_scene_module",
    "bind_skin": "bodies.skinning",
    "cameras": "cameras",
    "load_scene": "bodies.scene_files",
    "mesh_collider": "bodies.collider_entries",
    "read_experiment": "measured.experiment",
    "read_material_tests": "measured.material_test",
    "read_recording": "scenes.readers:read",
    "read_tracks": "measured.track",
    "scene_names": "bodies.scene_files",
    "shapes": "bodies.shapes",
    "write_experiment": "measured.experiment",
}
"""Module of each public name, relative to this package; after a colon, its name in that module if it differs."""


def __getattr__(name: str) -> Any:
    """Import a public name on first use."""
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    place, _, own = _PLACES[name].partition(":")
    module = import_module(f"{__name__}.{place}")
    value = module if name in ("cameras", "shapes") else getattr(module, own or name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """List the public names and the attributes of the module."""
    return sorted({*globals(), *__all__})
