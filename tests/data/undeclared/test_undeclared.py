"""Cases with an undeclared effect: what is written can be read, the key is sealed and true, the effect does what its kind says."""

import hashlib
from dataclasses import replace

import numpy as np
import pytest
import yaml

from neuido.commands.main import main
from neuido.data.measured.experiment import read_experiment
from neuido.data.measured.material_test import read_material_tests
from neuido.data.measured.track import read_tracks
from neuido.data.undeclared import Case, make_undeclared
from neuido.data.undeclared import random_bodies as bodies
from neuido.data.undeclared.body_case import draw_kinds
from neuido.data.undeclared.guided_tracks import KINDS as GUIDED
from neuido.data.undeclared.instruments import WRONG_NUISANCES
from neuido.data.undeclared.laboratory_tests import creep_test, fluid_curves, form_of, held_ramps, oscillation
from neuido.data.undeclared.motion import Motion, Solver, simulate_motion
from neuido.data.undeclared.random_effects import KINDS, OUTSIDE, Scales, draw_effect, truth_entry
from neuido.errors import UserError
from neuido.physics.effects.parameters import LIBRARY
from neuido.physics.effects.point_library import PLANE_ENTRIES, POINT_ENTRIES
from neuido.physics.fem.particle_weights import interpolation_weights
from neuido.types import Plane, Scene

SMALL = Case(particles=150, seconds=0.15, solver="same")
LAW = {"density": 1000.0, "elasticity": {"law": "fixed_corotated", "young": 1e5, "poisson": 0.3}, "plasticity": {"law": "identity"}}
SCENE = Scene(cells=24, dt=1e-3, gravity=(0.0, 0.0, 0.0), colliders=(Plane((0.0, 0.13, 0.0), (0.0, 1.0, 0.0)),))


def made(tmp_path, name="a", seed=3, **options):
    key = make_undeclared(seed, str(tmp_path / name), case=replace(SMALL, **options), device="cpu", progress=False)
    return tmp_path / name, yaml.safe_load(key.read_text())


@pytest.fixture(scope="module")
def drag(tmp_path_factory):
    return made(tmp_path_factory.mktemp("cases"), kind="drag_linear")


def test_folder_is_an_experiment_and_its_key_is_sealed(drag):
    folder, key = drag
    experiment = read_experiment(folder)
    assert [r.role for r in experiment.recordings] == ["fit", "held_out"]
    assert key["undeclared"][0]["diagnosis_names"] == ["drag_linear"]
    assert experiment.model["elasticity"]["young"] == key["started_from"]["young"] != key["material"]["young"]
    assert experiment.model["elasticity"]["law"] == key["material"]["elasticity"]
    for row in key["recordings"]:
        assert 15 <= row["separation_over_noise"] <= 160
    sealed = folder.parent / "keys" / "a.yaml"
    assert hashlib.sha256(sealed.read_bytes()).hexdigest() in (folder / "README.md").read_text()
    inside = b"".join(path.read_bytes() for path in folder.rglob("*") if path.is_file() and path.suffix != ".npz")
    assert b"drag" not in inside  # nothing in the folder tells
    assert not list(folder.parent.glob(".*"))


def test_recorded_motion_is_that_of_the_key(drag):
    folder, key = drag
    experiment = read_experiment(folder)
    law = {"density": key["material"]["density"], "elasticity": dict(LAW["elasticity"]), "plasticity": {"law": "identity"}}
    law["elasticity"] |= {"law": key["material"]["elasticity"], "young": key["material"]["young"], "poisson": key["material"]["poisson"]}
    scene = experiment.scene
    first = experiment.recordings[0]
    index, weight = (
        interpolation_weights(first.body.x.double(), first.anchor.double()) if first.track is None else (first.track[:, None], None)
    )
    weight = np.ones(index.shape) if weight is None else weight.numpy()
    values = {"drag_linear.k": key["undeclared"][0]["parameters"]["k"]}
    t = first.t.numpy()
    seconds = float(t[-1])
    solver = Solver("same", scene.cells, scene.dt)
    for given, low, high in ((values, 0.9, 1.1), ({}, 10.0, 200.0)):
        motion = simulate_motion(
            solver, scene, [r.body for r in experiment.recordings], law, given, seconds=seconds, interval=first.frame_interval / 2
        )
        x, _ = motion.at(t, 0)
        off = np.nanmean((np.einsum("nk,tnkc->tnc", weight, x[:, index.numpy()]) - first.x.numpy()) ** 2) ** 0.5 / first.noise
        assert low < off < high


def test_the_same_seed_gives_the_same_case(drag, tmp_path):
    folder, key = drag
    again, other = made(tmp_path, kind="drag_linear")
    assert other == key
    for path in folder.rglob("*.npz"):
        assert path.read_bytes() == (again / path.relative_to(folder)).read_bytes()
    assert made(tmp_path, kind="drag_linear")[1] == key  # it is there already
    with pytest.raises(UserError, match="is not the case of seed 4"):
        made(tmp_path, seed=4, kind="drag_linear")


def test_command(tmp_path, capsys):
    out = str(tmp_path / "a")
    for options, status in ((["--measured", "track"], 0), (["--kind", "magic"], 2)):
        with pytest.raises(SystemExit) as end:
            main(["undeclared", "--seed", "1", "--out", out, "--progress", "false", *options])
        assert end.value.code == status
    assert "choose from none, gravity" in capsys.readouterr().err
    assert read_tracks(tmp_path / "a").name == "a" and (tmp_path / "keys" / "a.yaml").is_file()


def test_a_wanted_case_that_cannot_be_made_leaves_nothing(tmp_path):
    with pytest.raises(UserError, match=r"in 12 draws \(last reason: "):
        made(tmp_path, kind="friction", separation=140.0, particles=100, seconds=0.05)
    assert not list(tmp_path.iterdir())


def test_a_case_whose_folder_cannot_be_published_leaves_no_key(tmp_path, monkeypatch):
    """Another process makes the folder when the key is there already."""
    from neuido.data.undeclared import sealed_folder

    write = sealed_folder.write_text

    def between(path, text):
        write(path, text)
        if path.parent.name == "keys":
            (tmp_path / "case").mkdir()
            (tmp_path / "case" / "mine.txt").touch()

    monkeypatch.setattr(sealed_folder, "write_text", between)
    with pytest.raises(UserError, match="another process"):
        make_undeclared(3, tmp_path / "case", case=Case(measured="track"), device="cpu", progress=False)
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["case", "mine.txt"]


def test_null_with_wrong_nuisances(tmp_path):
    folder, key = made(tmp_path, kind="none", nuisances=True)
    assert key["undeclared"] == [] and set(key["nuisances"]) == {"take1", "take2"}
    assert any(key["nuisances"]["take1"].values())
    first = read_experiment(folder).recordings[0]
    x = first.x.double().numpy()
    assert 3e-4 < np.nanstd(x[1] - x[0] - np.nanmean(x[1] - x[0], axis=0)) < 5e-2


def test_wrong_nuisances_are_those_that_a_diagnosis_expects():
    from neuido.discrepancy.problems.body import NUISANCES

    expected = {(name.removesuffix("_x"), unit, prior) for name, unit, prior in NUISANCES if not name.endswith(("_y", "_z"))}
    assert expected == set(WRONG_NUISANCES)


REFUSED = (
    {"kind": "magic"},
    {"kind": "drag_linear+magnet"},
    {"kind": "drag_linear", "nuisances": True},
    {"solver": "lattice"},
    {"separation": 3.0},
    {"measured": "video"},
    {"kind": "cohesion", "solver": "elements"},
    {"kind": "dry_drag", "solver": "elements"},
    {"particles": 3},
)


@pytest.mark.parametrize("option", REFUSED)
def test_what_cannot_be_made_is_refused(tmp_path, option):
    with pytest.raises(UserError, match="|".join(option)):
        made(tmp_path, **option)
    assert not list(tmp_path.iterdir())


def test_kinds_cover_the_vocabulary_and_what_is_outside_is_outside():
    names = {entry.name for entry in LIBRARY}
    of_tracks = {entry.name for entry in LIBRARY if entry.only == "track"}
    of_points = {entry.name for entry in (*POINT_ENTRIES, *PLANE_ENTRIES)}  # of material tests and plane specimens
    assert names - of_tracks - of_points <= {kind.partition(":")[0] for kind in KINDS} <= names and of_tracks <= set(GUIDED.values())
    assert not names & set(OUTSIDE) and len(OUTSIDE) >= 4
    scales = Scales(1e5, 1000.0, 0.3, np.full(3, 0.12), np.full(3, 0.4), 0.5, 1.5, 5e-4, 1 / 32, 5e3)
    known = {f"{entry.name}.{p.name}" for entry in LIBRARY for p in entry.parameters}
    for kind in (*KINDS, *OUTSIDE):
        drawn = draw_effect(kind, np.random.default_rng(0), scales)
        assert set(drawn.sizes) <= set(drawn.values) and any(drawn.values[s] for s in drawn.sizes)
        assert (set(drawn.values) <= known) == (kind in KINDS)
        assert set(truth_entry(drawn)["units"].values()) - {None}
        twice = drawn.scaled(2.0)
        assert all(twice.values[s] == 2 * drawn.values[s] for s in drawn.sizes)


def test_every_group_is_drawn():
    drawn = [draw_kinds(np.random.default_rng(seed), Case()) for seed in range(200)]
    counts = [sum(not k for k in drawn), sum(len(k) == 2 for k in drawn), sum(any(one in OUTSIDE for one in k) for k in drawn)]
    assert 45 < counts[0] < 90 and 5 < counts[1] < 50 and 10 < counts[2] < 50


# Effects outside the library, and two of it that only a body shows, against closed forms.


def thrown(values, *, velocity=(0.5, 0.0, 0.0), spin=(0.0, 0.0, 0.0), scene=SCENE, seconds=0.2, law=LAW) -> Motion:
    axis = (np.arange(4) - 1.5) * 0.04
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    launch = bodies.Launch(np.eye(3), np.array([0.4, 0.5, 0.5]), np.array(velocity), np.zeros((3, 3)))
    body = bodies.launched_body(points, 0.04**3, launch, spin=np.array(spin))
    return simulate_motion(Solver("same", scene.cells, scene.dt), scene, [body], law, values, seconds=seconds, interval=0.01)


@pytest.mark.parametrize("values", [{}, {"dry_drag.c": 0.1}])
def test_matter_that_collapses_is_an_event_of_the_motion(values):
    soft = LAW | {"elasticity": {**LAW["elasticity"], "young": 1e3}}
    events = thrown(values, velocity=(0.0, -8.0, 0.0), seconds=0.08, law=soft).events
    assert [event.kind for event in events] == ["collapsed"] and 0.04 < events[0].time < 0.08
    assert thrown(values, seconds=0.02).events == ()


def test_dry_drag_brakes_at_a_constant_rate():
    motion = thrown({"dry_drag.c": 1.0})
    v = motion.v[0].mean(axis=1)[:, 0]
    assert v[-1] == pytest.approx(0.3, abs=0.01)
    assert np.diff(v) == pytest.approx(-0.01, rel=0.06)


def test_spin_decay_leaves_the_centre_alone():
    motion = thrown({"spin_decay.k": 3.0}, spin=(0.0, 0.0, 2.0))
    free = thrown({}, spin=(0.0, 0.0, 2.0))

    def spin(m):
        arm = m.x[0] - m.x[0].mean(axis=1, keepdims=True)
        rest = m.v[0] - m.v[0].mean(axis=1, keepdims=True)
        return (np.cross(arm, rest).sum(axis=1) / (arm[..., :2] ** 2).sum(axis=(1, 2))[:, None])[:, 2]

    assert spin(motion)[-1] / spin(free)[-1] == pytest.approx(np.exp(-0.6), rel=0.02)
    assert motion.v[0].mean(axis=1)[-1] == pytest.approx([0.5, 0, 0], abs=1e-3)


def test_swelling_grows_the_volume():
    motion = thrown({"swelling.rate": 0.4}, velocity=(0.0, 0.0, 0.0), seconds=0.3)
    size = motion.x[0].std(axis=1).mean(axis=1)
    assert (size[-5:].mean() / size[0]) ** 3 == pytest.approx((1 + 0.4 * 0.28) ** 3, rel=0.03)


def test_magnet_pulls_as_the_fourth_power():
    near, far = (thrown({"magnet.m": 1e-3, "magnet.x": 0.4, "magnet.y": 0.5 - d, "magnet.z": 0.5}, velocity=(0.0, 0.0, 0.0), seconds=0.02)
                 for d in (0.3, 0.6))  # fmt: skip
    pull = [m.v[0].mean(axis=1)[-1, 1] for m in (near, far)]
    assert pull[0] / pull[1] == pytest.approx(16.0, rel=0.15) and pull[0] < 0


def test_moving_floor_leaves_the_flight_alone_and_lifts_what_rests():
    values = {"moving_floor.amplitude": 0.01, "moving_floor.frequency": 2.5}
    assert thrown(values).x == pytest.approx(thrown({}).x, abs=2e-4)
    scene = replace(SCENE, gravity=(0.0, -9.8, 0.0), colliders=(Plane((0.0, 0.42, 0.0), (0.0, 1.0, 0.0)),))
    moved, still = (thrown(v, velocity=(0.0, 0.0, 0.0), scene=scene) for v in (values, {}))
    lift = (moved.x - still.x)[0].mean(axis=(1, 2)) * 3  # the mean over three coordinates, of which one moves
    assert lift[-1] == pytest.approx(0.02, abs=0.004)


def test_delayed_spring_pulls_to_where_the_body_was():
    k, delay = 20.0, 0.05
    motion = thrown({"delayed_spring.k": k, "delayed_spring.delay": delay, "delayed_spring.x": 0.3, "delayed_spring.y": 0.5,
                     "delayed_spring.z": 0.5}, velocity=(0.5, 0.0, 0.0))  # fmt: skip
    x, t = motion.x[0].mean(axis=1)[:, 0], np.arange(21) * 0.01
    acceleration = np.diff(x, 2) / 0.01**2
    then = np.interp(t[1:-1] - delay, t, x, left=x[0])
    assert acceleration == pytest.approx(-k * (then - 0.3), abs=0.15)


def test_density_gradient_turns_a_thrown_body_about_another_centre():
    motion = thrown({"density_gradient.x": 2.0, "density_gradient.y": 0.0, "density_gradient.z": 0.0}, spin=(0.0, 0.0, 2.0))
    free = thrown({}, spin=(0.0, 0.0, 2.0))
    off = motion.v[0].mean(axis=1)[:, 1] - free.v[0].mean(axis=1)[:, 1]
    x = (np.arange(4) - 1.5) * 0.04
    arm = np.average(x, weights=np.exp(2.0 * x / np.ptp(x)))  # from the middle to the centre of mass, which moves uniformly
    assert off[-1] == pytest.approx(2.0 * arm * (1 - np.cos(0.4)), rel=0.03)


# Curves.


def test_kinds_of_test():
    """A relaxation may be shown by a path, an oscillation, a creep test or a ramp that is held; a flow law by flow curves alone."""
    drawn = {kind: {form_of(np.random.default_rng(seed), kind) for seed in range(60)} for kind in ("fractional", "thixotropy")}
    assert drawn["fractional"] == {None, oscillation, creep_test, held_ramps}
    assert drawn["thixotropy"] == {fluid_curves}


@pytest.mark.parametrize(
    ("measured", "kind", "read"),
    [
        ("material_test", "mullins", read_material_tests),
        ("material_test", "herschel_bulkley", read_material_tests),
        ("material_test", "thixotropy", read_material_tests),
        ("material_test", "creep", read_material_tests),
        ("material_test", "compaction", read_material_tests),
        ("material_test", "second_invariant", read_material_tests),
        ("track", "magnus", read_tracks),
        ("guided", "spring:dry_friction", read_tracks),
    ],
)
def test_curves(tmp_path, measured, kind, read):
    key = make_undeclared(1, str(tmp_path / "c"), case=Case(measured=measured, kind=kind), device="cpu", progress=False)
    content = yaml.safe_load(key.read_text())
    assert content["undeclared"][0]["kind"] == kind.rpartition(":")[2] and read(tmp_path / "c").name == "c"
    rows = content.get("tests", content.get("recordings"))
    assert rows[0]["separation_over_noise"] > 15


@pytest.mark.parametrize(
    ("measured", "kind", "outside"),
    [
        ("material_test", "maxwell+strain_stiffening", False), ("track", "drag_quadratic+magnus", False),
        ("guided", "pendulum:drag_linear+dry_friction", False), ("material_test", "swinging_stiffness", True), ("track", "dry_drag", True),
    ],
)  # fmt: skip
def test_curves_have_pairs_and_effects_outside_the_library(tmp_path, measured, kind, outside):
    """Each effect of a pair is as large as one alone, and an effect outside the library is named like none in it."""
    key = yaml.safe_load(
        make_undeclared(1, tmp_path / "a", case=Case(measured=measured, kind=kind), device="cpu", progress=False).read_text()
    )
    assert [one["kind"] for one in key["undeclared"]] == kind.rpartition(":")[2].split("+")
    assert [one["outside_library"] for one in key["undeclared"]] == [outside] * len(key["undeclared"])
    assert all(not set(one["diagnosis_names"]) & {entry.name for entry in LIBRARY} for one in key["undeclared"] if outside)
    rows = key.get("recordings") or key["tests"]
    assert rows[0]["separation_over_noise"] > 8
