"""Renamed options are taken under their old names, with a warning, wherever a user may have written them."""

import inspect

import pytest
import yaml

from neuido.data.files.renamed_options import RENAMED, rename_in_arguments, rename_in_configuration, renamed_arguments, renamed_options
from neuido.errors import UserError
from neuido.models import KnownLaw, RandomLatent, ReconstructModule, SpringMass
from tests.command import run


@pytest.fixture
def spring():
    """A class with a renamed option, forgotten after the test."""
    known = set(RENAMED)

    @renamed_options(k="stiffness")
    class Spring:
        """A spring."""

        def __init__(self, stiffness: float = 1.0, rest: float = 0.5):
            self.stiffness, self.rest = stiffness, rest

    yield Spring
    for path in RENAMED.keys() - known:
        del RENAMED[path]


def test_old_name_is_taken(spring):
    with pytest.warns(FutureWarning, match=r"Spring\.k is now called Spring\.stiffness"):
        assert spring(k=3.0, rest=0.1).stiffness == 3.0


def test_new_name_gives_no_warning(spring, recwarn):
    assert (spring(2.0).stiffness, spring(stiffness=4.0).stiffness, spring().rest) == (2.0, 4.0, 0.5)
    assert not recwarn


def test_signature_shows_the_new_names(spring):
    assert list(inspect.signature(spring).parameters) == ["stiffness", "rest"]


def test_both_names_are_refused(spring):
    with pytest.raises(UserError, match=r"Spring\.k is the former name of Spring\.stiffness"):
        spring(k=3.0, stiffness=3.0)


@pytest.mark.parametrize("path", ["SpringMass", "neuido.models.baselines.spring_gaus.SpringMass"])
def test_configuration(path):
    old = {"model": {"init_args": {"method": {"class_path": path, "init_args": {"per": "body", "power": 0.0}}}}, "list": [1]}
    with pytest.warns(FutureWarning, match=r"SpringMass\.per"):
        new = rename_in_configuration(old)
    assert new["model"]["init_args"]["method"]["init_args"] == {"stiffness_per": "body", "power": 0.0}
    assert new["list"] == [1]
    other = {"class_path": "LowRankAdaptation", "init_args": {"start": "mean", "per": 1}}
    assert rename_in_configuration(other) == other


def test_command_line():
    modules = ["neuido.models.baselines.spring_gaus", "neuido.models.baselines.known_law"]
    given = ["fit", "--model.method.firm=4", "--model.method.init_args.free", "[young]", "--model.method.firmly", "per", "--data.per", "2"]
    with pytest.warns(FutureWarning, match="full_stiffness_neighbours"), pytest.warns(FutureWarning, match="free_parameters"):
        found = rename_in_arguments(given, "model.method", modules)
    assert found[1:3] == ["--model.method.full_stiffness_neighbours=4", "--model.method.init_args.free_parameters"]
    assert [found[0], *found[3:]] == [given[0], *given[3:]]


@pytest.mark.parametrize(
    ("build", "name", "value"),
    [
        (lambda: KnownLaw(free=["young"]), "free_parameters", ["young"]),
        (lambda: RandomLatent(of="trained"), "distribution", "trained"),
        (lambda: SpringMass(per="body"), "stiffness_per", "body"),
        (lambda: SpringMass(firm=3), "full_stiffness_neighbours", 3),
    ],
)
def test_methods(build, name, value):
    with pytest.warns(FutureWarning, match=name):
        assert getattr(build(), name) == value


def test_reconstruction():
    with pytest.warns(FutureWarning):
        module = ReconstructModule(start=4, limit=9, largest=0.1)
    assert (module.hparams.initial_gaussians, module.hparams.max_gaussians, module.hparams.max_scale) == (4, 9, 0.1)


def test_a_run_takes_an_old_configuration_and_an_old_option(tmp_path, capsys):
    method = {"class_path": "SpringMass", "init_args": {"per": "body", "anchors": 8}}
    model = {"class_path": "AdaptModule", "init_args": {"method": method}}
    data = {"class_path": "VisualDataModule", "init_args": {"root": str(tmp_path)}}
    (tmp_path / "old.yaml").write_text(yaml.safe_dump({"model": model, "data": data}))
    with pytest.warns(FutureWarning, match="stiffness_per"), pytest.warns(FutureWarning, match="full_stiffness_neighbours"):
        status, out, err = run(capsys, "fit", "--config", tmp_path / "old.yaml", "--model.method.firm", 4, "--print_config")
    assert status == 0, err
    found = yaml.safe_load(out)["model"]["init_args"]["method"]["init_args"]
    assert (found["stiffness_per"], found["full_stiffness_neighbours"], found["anchors"]) == ("body", 4, 8)


def test_an_argument_of_a_function():
    @renamed_arguments(most="max_effects")
    def count(folder: str, *, max_effects: int = 3) -> int:
        return max_effects

    assert (count("a"), count("a", max_effects=2)) == (3, 2)
    assert list(inspect.signature(count).parameters) == ["folder", "max_effects"]
    with pytest.warns(FutureWarning, match=r"count\.most is now called count\.max_effects"):
        assert count("a", most=1) == 1


@pytest.mark.parametrize("written", ["--most", "--most=", "file"])
def test_an_option_of_a_function_command(written, tmp_path, capsys):
    """The old name reaches the command, which refuses the value under the new one."""
    (tmp_path / "old.yaml").write_text("most: 9\nseed: 0\n")
    given = {"--most": ["--most", "9"], "--most=": ["--most=9"], "file": ["--config", str(tmp_path / "old.yaml")]}[written]
    with pytest.warns(FutureWarning, match=r"diagnose\.most is now called diagnose\.max_effects"):
        status, _, err = run(capsys, "diagnose", str(tmp_path), "--out", str(tmp_path / "out"), *given)
    assert status == 2 and "max_effects = 9 must be 1, 2 or 3" in err
