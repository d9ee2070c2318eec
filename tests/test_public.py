"""The public surface: which names there are, that each is documented, and that what users read imports nothing deeper."""

import ast
import inspect
import os
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest
import yaml

import neuido

ROOT = Path(__file__).parents[1]
PUBLIC = {
    "neuido": """
        AttachedMass Attachment Body Box Cameras Diagnosis Encoder FiniteElements Frames Gaussians Keyframes Operator OwnEffect
        ParticleState Plane Scene Simulator Skin UserError Walls __version__ colliders configs_root diagnose effects export
        import_file import_scene laws load_scene rasterize read_experiment read_law read_material_tests
        read_plane_experiment read_recording read_tracks render shapes show view
    """,
    "neuido.data": """
        Experiment FilmDataModule MaterialTest MaterialTests MultiView MultiViewDataModule PlaneExperiment PlaneRecording
        Recording SceneSetup Track Tracks
        TrajectoryDataModule VisualDataModule bind_skin cameras load_scene mesh_collider read_experiment read_material_tests
        read_plane_experiment read_recording read_tracks scene_names shapes write_experiment
    """,
    "neuido.models": """
        AdaptModule AlignModule ChamferDistance DynamicsEncoder Encoder FlowVAE FlowVAEModule
        IntrinsicDynamicsOperator KnownLaw LPIPS LowRankAdaptation MadeSceneDataModule MatchedRMSE MeanLatent
        MedianRelativeError Method Moduli NCLaw NeuMA Operator PreparedScene PretrainModule RandomLatent Reading
        Readings ReconstructModule SparseLaw Splatting SpringMass UniPhy VideoLaw WarmupModule attach_gaussians bind
        chamfer_distance deform fill load_gaussians load_law load_nclaw opacity_volume prepare rasterize read_law
        relative_lp render save_gaussians save_law small_strain_moduli visual_hull write_particles write_video
    """,
    "neuido.physics": "FiniteElements Frames MassSpring Mesh PlaneMotion PlaneSpecimen Simulator colliders effects laws mesh_body",
    "neuido.physics.colliders": """
        Capsule ColliderFrames ColliderTable Cuboid Cylinder Grip HalfSpace HeightField MeshCollider SolidInputs Sphere
        collider_table planes_of
    """,
    "neuido.physics.effects": "Effects Entry LIBRARY Parameter ball_inclusion linear_gradient",
    "neuido.physics.laws": """
        AutogradElastic AutogradPlastic BoundedElastic DruckerPrager ElasticLaw FixedCorotated Fluid Gent Hyperfoam Identity
        InvariantElastic InvariantPlastic MooneyRivlin NeoHookean ObjectiveElastic ObjectivePlastic PlasticLaw RawElastic RawPlastic
        Sigma Snow SymbolicElastic SymbolicPlastic VolumetricReset VonMises by_body material stack
    """,
    "neuido.discrepancy": "DiagnosedEffects Diagnosis Effect ErrorChange OwnEffect Quantity diagnose",
}
NAMES = [(room, name) for room, text in PUBLIC.items() for name in text.split()]
ROOMS = ("neuido", "neuido.physics", "neuido.data", "neuido.models", "neuido.discrepancy")


@pytest.mark.parametrize("room", PUBLIC)
def test_the_list_is_whole(room):
    package = import_module(room)
    assert sorted(package.__all__) == sorted(PUBLIC[room].split())
    assert set(package.__all__) <= set(dir(package))
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = package.no_such_name


@pytest.mark.parametrize(("room", "name"), NAMES)
def test_every_name_is_there_and_documented(room, name):
    value = getattr(import_module(room), name)
    if isinstance(value, tuple):  # LIBRARY, which the effects' own page documents
        assert value
    elif name == "__version__":
        assert re.fullmatch(r"\d+\.\d+\.\d+\S*", value)
    else:
        words = inspect.getdoc(value)
        assert words and len(words.split()) > 2, f"{room}.{name} has no docstring"
        assert isinstance(value, ModuleType) or not words.startswith(f"{name}("), f"{room}.{name} has the docstring that Python made"


def test_type_checkers_see_every_name():
    """What is imported lazily stands in a stub, from which the names are imported too; an editor then completes and documents them."""
    for face in Path(neuido.__file__).parent.rglob("__init__.pyi"):
        room = ".".join(face.parent.relative_to(ROOT).parts)
        tree = ast.parse(face.read_text())
        imported = [alias for node in tree.body if isinstance(node, ast.ImportFrom) for alias in node.names]
        (listed,) = (ast.literal_eval(node.value) for node in tree.body if isinstance(node, ast.Assign))
        assert not [alias.name for alias in imported if alias.asname], f"{room}: another name is not seen at run time"
        assert sorted(alias.name for alias in imported) == sorted(listed) == import_module(room).__all__, room
    assert {(Path(import_module(room).__file__).parent / "__init__.pyi").is_file() for room in PUBLIC} == {True}
    assert (Path(neuido.__file__).parent / "py.typed").is_file()


@pytest.mark.parametrize("code", ["import neuido; neuido.Simulater", "import neuido.physics; neuido.physics.Simulater"])
def test_a_wrong_name_is_told_with_the_right_one(code):
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False)
    assert re.search(r"AttributeError: No neuido\S* attribute Simulater\. Did you mean: 'Simulator'\?$", answer.stderr.strip())


def test_import_and_listing_load_no_torch():
    code = "import sys, neuido; dir(neuido); neuido.Scene; neuido.UserError; print(neuido.__version__, 'torch' in sys.modules)"
    light = code.replace("neuido.Scene; ", "")  # a scene is made of tensors
    answer = subprocess.run([sys.executable, "-c", light], capture_output=True, text=True, cwd=ROOT, check=True)
    assert answer.stdout.split() == [neuido.__version__, "False"]


def test_export_is_a_function_beside_the_folder_of_that_name():
    import_module("neuido.export.exporting")
    from neuido import export

    assert callable(export) and neuido.export is export


@pytest.mark.slow
def test_export_is_a_function_whatever_was_imported_first():
    code = "import neuido.export.exporting, neuido; from neuido import export; print(callable(neuido.export), callable(export))"
    code += "; import neuido.export.series; print(neuido.export is export)"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert answer.stdout.split() == ["True", "True", "True"]


def sources() -> list[tuple[str, str]]:
    """Return name and Python of each piece of code that a user copies."""
    scripts = [path for folder in ("examples", "notebooks") for path in (ROOT / folder).rglob("*.py")]
    found = [(path.relative_to(ROOT).as_posix(), path.read_text()) for path in scripts]
    for page in (ROOT / "README.md", *(ROOT / "docs").rglob("*.md")):
        blocks = re.findall(r"^```(?:python|\{code-cell\}.*?)\n(.*?)^```", page.read_text(), re.M | re.S)
        found += [(f"{page.relative_to(ROOT).as_posix()}[{i}]", block) for i, block in enumerate(blocks)]
    return found


def deep_imports(source: str) -> set[str]:
    """Return the modules of neuido below its public packages that a source imports from."""
    deep = set()
    for node in ast.walk(ast.parse(source)):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module]
        deep |= {name for name in names if name.split(".")[0] == "neuido" and name not in ROOMS}
    return deep


def test_deep_imports_are_seen():
    assert deep_imports("import neuido\nfrom neuido.data import a\nfrom neuido.data.b import c\nimport neuido.x") == {
        "neuido.data.b",
        "neuido.x",
    }


@pytest.mark.parametrize(("name", "source"), sources())
def test_what_users_copy_imports_public_names_alone(name, source):
    deep = deep_imports(source)
    assert not deep, f"{name} imports from {sorted(deep)}; users import from {', '.join(ROOMS)} alone"


EXAMPLES = ("simulate_a_drop", "law_from_video", "diagnose_a_throw")


def code_lines(source: str) -> list[str]:
    """Return the lines of a source without its docstring, comments and blank lines."""
    words = ast.get_docstring(ast.parse(source), clean=False) or ""
    lines = source.replace(f'"""{words}"""', "", 1).splitlines()
    return [line for line in lines if line.strip() and not line.strip().startswith("#")]


@pytest.mark.parametrize("name", EXAMPLES)
def test_each_job_takes_fifteen_lines(name):
    assert 5 <= len(code_lines((ROOT / "examples" / f"{name}.py").read_text())) <= 15


def run_example(name: str, folder: Path) -> str:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "MPLBACKEND": "agg"}
    command = [sys.executable, str(ROOT / "examples" / f"{name}.py")]
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_simulate_gives_a_gradient_through_the_drop(tmp_path):
    height, slope = map(float, re.findall(r"(-?\d\.\d+(?:e-?\d+)?) m", run_example("simulate_a_drop", tmp_path)))
    assert 0.1 < height < 0.5
    assert slope != 0
    assert (tmp_path / "drop.npz").is_file()


@pytest.mark.slow
def test_diagnose_names_the_drag(tmp_path):
    said = run_example("diagnose_a_throw", tmp_path)
    size = re.search(r"The model lacks quadratic air drag: k = ([\d.]+) per metre", said)
    assert abs(float(size[1]) - 0.12) < 0.003  # the truth, in the example
    assert (tmp_path / "throw.png").stat().st_size > 5000


@pytest.mark.slow
def test_video_gives_a_law(tmp_path):
    """The modulus of a ball of 30 kPa is read within the factor of two that the tutorial states."""
    young = 1e3 * float(re.search(r"E = ([\d.]+) kPa", run_example("law_from_video", tmp_path))[1])
    truth = yaml.safe_load((tmp_path / "film" / "Ball" / "truth.yaml").read_text())["law"]["elasticity"]["young"]
    assert 0.5 < young / truth < 2
    assert (tmp_path / "law.safetensors").is_file()
