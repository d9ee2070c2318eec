"""Points under a constraint: what their folders must say, and fits of made recordings."""

import warnings

import numpy as np
import pytest
import yaml

from neuido.data.measured.motion_plausibility import check_bounces
from neuido.data.measured.track import read_tracks
from neuido.data.undeclared import Case, make_undeclared
from neuido.discrepancy.inference.least_squares import levenberg_marquardt, run
from neuido.discrepancy.problems.tracks.track_candidates import typical_speed
from neuido.discrepancy.problems.tracks.track_problem import MOST_FRAMES, TrackProblem, track_problems
from neuido.errors import PlausibilityWarning, UserError
from neuido.physics.points.point_mass import Forces, fly


def made(tmp_path, kind, seed=1):
    """A folder of the blind harness, its problem, and what it lacks."""
    folder = tmp_path / "case"
    key = make_undeclared(seed, str(folder), case=Case(measured="guided", kind=kind), device="cpu", progress=False)
    truth = yaml.safe_load(key.read_text())
    values = {f"{u['kind']}.{k}": v for u in truth["undeclared"] for k, v in u["parameters"].items()}
    return folder, track_problems(folder)[0], values


def errors(problem: TrackProblem, point) -> list[float]:
    """The errors of each recording, in units of its noise."""
    return [problem.error(problem.predict([point], n)[0] - r.y, n) / r.noise for n, r in enumerate(problem.recordings)]


FAST = ("plane:dry_friction", "bounce:bounce_friction", "water:buoyancy")
KINDS = (
    "pendulum:dry_friction", "spring:drag_quadratic", "axis:drag_linear", "disc:lift", "spring:local_force", "bounce:bounce_speed",
)  # fmt: skip


@pytest.mark.parametrize("kind", [*FAST, *(pytest.param(kind, marks=pytest.mark.slow) for kind in KINDS)])
def test_the_true_effect_leaves_noise_and_no_other_declared_figure_does(tmp_path, kind):
    _, problem, truth = made(tmp_path, kind)
    effect = kind.partition(":")[2]
    own = next(c for c in problem.candidates if c.name == effect)
    start = {name: truth.get(name, own.starts[0][name]) for name in own.starts[0]}
    (fit,) = run(problem, [levenberg_marquardt((*problem.declared, *own.parameters), start)],
                 lambda r, n: r / problem.recordings[n].noise, problem.roles["fit"])  # fmt: skip
    *fitted, held_out = errors(problem, fit.point)
    assert max(fitted) < 1.3 and held_out < 2.0
    for size in own.size_parameters:
        if size.name in truth and effect != "lift":  # the drag of a disc stands in for a part of the other
            assert fit.point[size.name] == pytest.approx(truth[size.name], rel=0.15)
    (base,) = run(problem, [levenberg_marquardt(problem.declared, {})],
                  lambda r, n: r / problem.recordings[n].noise, problem.roles["fit"])  # fmt: skip
    assert max(errors(problem, base.point)) > 2.0


def test_the_model_after_declares_the_same_motion(tmp_path):
    folder, problem, _ = made(tmp_path, "bounce:bounce_friction")
    values = {"restitution": 0.8, "bounce_friction.mu": 0.03}
    content = yaml.safe_load((folder / "track.yaml").read_text())
    content["model"] = problem.model_after(values, ["bounce_friction"])
    declared = {"type": "bounce", "floor": 0.03, "restitution": 0.8, "friction": 0.0, "inertia": 0.4}
    assert content["model"]["constraint"] == declared and content["model"]["effects"] == {"bounce_friction.mu": 0.03}
    (folder / "track.yaml").write_text(yaml.safe_dump(content))
    (again,) = track_problems(folder)
    np.testing.assert_allclose(again.predict([{}], 0), problem.predict([values], 0), atol=2e-3)


def test_a_declared_stiffness_may_go_up_and_down(tmp_path):
    _, problem, _ = made(tmp_path, "spring:drag_linear")
    (stiffness,) = problem.declared
    assert stiffness.lower < 0.1 * stiffness.value and stiffness.upper > 10 * stiffness.value


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"constraint": {"type": "rope"}}, "type = 'rope' is unknown: choose from pendulum, spring"),
        ({"constraint": {"type": "pendulum"}}, "length"),
        ({"constraint": {"type": "spring", "stiffness": 3.0}, "columns": {"t": "t", "y": "y"}}, "bodies.bob has no mass"),
        ({"constraint": {"type": "axis"}}, "has no angle"),
        ({"constraint": {"type": "pendulum", "length": 1.0}, "columns": {"t": "t", "x": "x"}}, "needs its angle [rad], or two"),
        ({"constraint": {"type": "pendulum", "length": 1.0}, "gravity": [0, 0, 0]}, "needs gravity"),
        ({"constraint": {"type": "bounce", "floor": 0.0, "restitution": 1.2}}, "at most 1"),
        ({"constraint": {"type": "plane", "inertia": 0.4, "normal": [0, 0, 0]}}, "normal must not be zero"),
        ({"columns": {"t": "t", "angle": "x"}}, "give model.constraint of the type pendulum or axis"),
        ({"columns": {"t": "t", "angle": "x", "y": "y"}}, "give one of the two"),
        ({"shape": "cube"}, "shape = 'cube' is unknown"),
    ],
)
def test_what_is_missing_is_said(tmp_path, change, message):
    t = np.arange(0, 2, 0.05)
    np.savetxt(tmp_path / "a.csv", np.column_stack([t, np.sin(3 * t), 0.1 * np.cos(6 * t)]), delimiter=",", header="t,x,y", comments="")
    model = {"gravity": change.get("gravity", [0, -9.81, 0])} | ({"constraint": change["constraint"]} if "constraint" in change else {})
    recording = {
        "name": "a",
        "body": "bob",
        "file": "a.csv",
        "columns": change.get("columns", {"t": "t", "x": "x", "y": "y"}),
        "role": "fit",
    }
    bodies = {"bob": {"shape": change["shape"]} if "shape" in change else None}
    content = {"format": "neuido-track/1", "name": "bob", "model": model, "bodies": bodies, "recordings": [recording]}
    (tmp_path / "track.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(UserError) as told:
        read_tracks(tmp_path)
    assert message in str(told.value) and "\n" not in str(told.value)


def test_a_speed_counts_the_way_back_and_a_long_recording_is_thinned(tmp_path):
    folder, problem, _ = made(tmp_path, "spring:drag_linear")
    track = read_tracks(folder).recordings[0]
    rate = (problem.tracks.constraint.figures["stiffness"] / problem.tracks.bodies["body"]["mass"]) ** 0.5
    assert typical_speed(track) > 0.2 * rate * float(np.abs(track.x - track.x.mean()).max())
    rows = np.loadtxt(folder / "run-1.csv", delimiter=",", skiprows=1)
    fine = np.interp(np.linspace(0, rows[-1, 0], 20_000), rows[:, 0], rows[:, 1])
    table = np.column_stack([np.linspace(0, rows[-1, 0], 20_000), fine])
    np.savetxt(folder / "run-1.csv", table, delimiter=",", header="t,y", comments="")
    (long,) = track_problems(folder)
    assert MOST_FRAMES / 2 < len(long.recordings[0].y) <= MOST_FRAMES


def test_a_bounce_in_a_free_flight_is_said_and_a_throw_or_a_swing_is_none():
    t = np.arange(0.0, 1.4, 1 / 60)
    floor = Forces(floor_normal=np.array([0.0, 1.0, 0.0]), floor_height=0.0, restitution=0.8)
    drop = fly(t, np.array([[0.0, 1.0, 0.0]]), np.zeros((1, 3)), np.zeros(1), floor)[0, :, 1]
    with pytest.warns(PlausibilityWarning, match="type: bounce"):
        check_bounces(t, drop + 0.002 * np.random.default_rng(0).standard_normal(len(t)), "y", "drop")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for other in (6 * t - 4.9 * t**2, -4.9 * t**2, 0.3 * np.sin(3 * t)):
            check_bounces(t, other, "y", "other")


def test_a_spin_is_a_nuisance_and_shows_only_where_something_was_measured(tmp_path):
    t = np.arange(0, 1, 0.02)
    table = np.column_stack([t, 3 * t, 1 + 4 * t - 4.905 * t**2, 0.1 * t])
    np.savetxt(tmp_path / "a.csv", table, delimiter=",", header="t,x,y,z", comments="")
    for columns, wanted in ((("x", "y"), ["z"]), (("x", "y", "z"), ["x", "y", "z"]), (("y",), [])):
        recordings = [{"name": "a", "body": "ball", "file": "a.csv", "columns": {c: c for c in ("t", *columns)}, "role": "fit"}]
        content = {"format": "neuido-track/1", "name": "ball", "model": {"gravity": [0, -9.81, 0]}, "bodies": {"ball": None}}
        (tmp_path / "track.yaml").write_text(yaml.safe_dump(content | {"recordings": recordings}))
        (problem,) = track_problems(tmp_path)
        magnus = [p.name for c in problem.candidates if c.name == "magnus" for p in c.parameters]
        assert magnus == [f"magnus.{a}" for a in wanted]
        assert not [p.name for p in problem._starts[0].parameters if p.name.startswith("spin")]  # the recordings share one
    recordings[0] |= {"columns": {"t": "t", "x": "x", "y": "y"}, "spin": [0, 0, 30.0]}
    (tmp_path / "track.yaml").write_text(yaml.safe_dump(content | {"recordings": recordings, "nuisances": {"spin": 0.1}}))
    (problem,) = track_problems(tmp_path)
    (own,) = (p for p in problem._starts[0].parameters if p.name.startswith("spin"))
    assert own.scale * own.prior == pytest.approx(0.1)


def test_what_the_attitude_of_a_disc_leaves_belongs_to_its_noise(tmp_path):
    _, problem, truth = made(tmp_path, "disc:lift")
    held = problem.roles["held_out"][0]
    assert problem.noise_with({}, held) == pytest.approx(problem.recordings[held].noise)
    assert problem.noise_with(truth, held) > 1.5 * problem.recordings[held].noise
