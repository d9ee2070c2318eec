from . import cameras
from .bodies import shapes
from .bodies.collider_entries import mesh_collider
from .bodies.scene_files import SceneSetup, load_scene, scene_names
from .bodies.skinning import bind_skin
from .clips import FilmDataModule
from .formats.layout import MultiView
from .measured.experiment import Experiment, Recording, read_experiment, write_experiment
from .measured.material_test import MaterialTest, MaterialTests, read_material_tests
from .measured.plane_experiment import PlaneExperiment, PlaneRecording, read_plane_experiment
from .measured.track import Track, Tracks, read_tracks
from .scenes.filmed_scene_module import VisualDataModule
from .scenes.multiview import MultiViewDataModule
from .scenes.readers import read_recording
from .trajectories.trajectory_module import TrajectoryDataModule

__all__ = [
    "Experiment",
    "FilmDataModule",
    "MaterialTest",
    "MaterialTests",
    "MultiView",
    "MultiViewDataModule",
    "PlaneExperiment",
    "PlaneRecording",
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
    "read_plane_experiment",
    "read_recording",
    "read_tracks",
    "scene_names",
    "shapes",
    "write_experiment",
]
