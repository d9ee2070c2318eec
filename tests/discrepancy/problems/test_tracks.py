import math

import numpy as np
import pytest
import yaml

from neuido.data.measured.track import read_tracks
from neuido.discrepancy.inference.least_squares import levenberg_marquardt, run
from neuido.discrepancy.problems.noise import correlation, strays
from neuido.discrepancy.problems.tracks.track_problem import TrackProblem, flight_of, track_problems
from neuido.physics.points.point_mass import Forces, fly

T = np.arange(0, 3.0, 1 / 15)


def write(folder, bodies, *, nuisances=None, model=None, columns=None, seed=0, noise=0.03, impact=False):
    """Drops of bodies, each fitted on one and held out on another: body -> Forces."""
    rng = np.random.default_rng(seed)
    recordings = []
    columns = columns or {"y": 1}
    for body, forces in bodies.items():
        for role, release, scale in (("fit", 0.12, 0.01), ("held_out", 0.05, -0.02)):
            x0 = np.array([[2.0, 46.0, 1.0]])
            v0 = np.array([[6.0 if "x" in columns else 0.0, 0.0, 0.0]])
            seen = x0 + (1 + scale) * (fly(T, x0, v0, np.array([release]), forces)[0] - x0)
            seen = seen + noise * rng.standard_normal(seen.shape)
            if impact:
                seen[-2:] = seen[-3] + 0.2
            file = f"{body}-{role}.csv"
            rows = np.column_stack([T, *(seen[:, a] for a in columns.values())])
            np.savetxt(folder / file, rows, delimiter=",", header=",".join(["t", *columns]), comments="")
            titles = {key: key for key in ("t", *columns)}
            recordings.append({"name": f"{body}-{role}", "body": body, "file": file, "role": role, "columns": titles})
    content = {
        "format": "neuido-track/1",
        "name": "made",
        "model": model or {"gravity": [0, -9.81, 0]},
        "nuisances": {"release_time": 0.2, "length_scale": 0.05} if nuisances is None else nuisances,
        "bodies": {body: {"mass": 0.03, "diameter": 0.08} for body in bodies},
        "recordings": recordings,
    }
    (folder / "track.yaml").write_text(yaml.safe_dump(content, sort_keys=False))
    return folder


def fitted(problem: TrackProblem, *names: str):
    """The best fit of some effects: the point, and its errors on the fitted and the held-out recording [m]."""
    parameters = (*problem.declared, *(p for c in problem.candidates if c.name in names for p in c.parameters))
    start = {k: v for c in problem.candidates if c.name in names for k, v in c.starts[0].items()}
    (fit,) = run(problem, [levenberg_marquardt(parameters, start)], lambda r, n: r / 0.03, problem.roles["fit"])
    return fit.point, *(problem.error(problem.predict([fit.point], n)[0] - problem.recordings[n].y, n) for n in (0, 1))


def test_a_true_model_is_left_with_its_noise(tmp_path):
    (problem,) = track_problems(write(tmp_path, {"stone": Forces()}))
    assert [len(r.y) for r in problem.recordings] == [45, 45 - 18] and problem.unit == "m" and problem.nuisances == ()
    left = [problem.error(problem.predict([{}], n)[0] - problem.recordings[n].y, n) for n in (0, 1)]
    assert left[0] < 0.04 and left[1] < 3 * problem.recordings[1].noise
    found = problem.nuisances_of({}, 0)
    assert found["release_time:stone-fit"] == pytest.approx(0.12, abs=0.08) and abs(found["length_scale:stone-fit"] - 0.01) < 0.02
    assert problem.recordings[0].noise == pytest.approx(0.03, rel=0.6) and problem.recordings[1].noise > problem.recordings[0].noise
    for name in ("drag_linear", "drag_quadratic"):
        assert fitted(problem, name)[2] > 0.7 * left[1]  # nothing to gain


@pytest.mark.slow
def test_drag_is_found_on_the_body_that_has_it(tmp_path):
    """One of two bodies feels the air; what acts on both alike is left out, or narrowed, for they do not agree on it."""
    bodies = {"stone": Forces(), "feather": Forces(drag_quadratic=0.04)}
    stone, feather = track_problems(write(tmp_path, bodies))
    for problem in (stone, feather):
        assert {"position_force", "time_force"} <= set(problem.labels["excluded"])
        assert all(p.lower > -4.9 for c in problem.candidates if c.name == "gravity" for p in c.parameters)  # narrowed by the other
        assert {c.name for c in problem.candidates} >= {"drag_linear", "drag_quadratic", "added_mass"}
    before = feather.error(feather.predict([{}], 1)[0] - feather.recordings[1].y, 1)
    point, fit, held = fitted(feather, "drag_quadratic")
    assert point["drag_quadratic.k"] == pytest.approx(0.04, rel=0.1) and fit < 0.045 and held < 0.1 * before
    assert fitted(feather, "drag_linear")[1] > 1.3 * fit and fitted(feather, "added_mass")[2] > 5 * held
    assert fitted(feather, "gravity")[2] > 3 * held
    point, _, _ = fitted(stone, "drag_quadratic")
    assert point["drag_quadratic.k"] < 1e-3


def test_what_acts_on_all_bodies_stays_a_candidate(tmp_path):
    forces = Forces(uniform_acceleration=np.array([0.5, 0.0, 0.0]))
    problems = track_problems(write(tmp_path, {"a": forces, "b": forces}, columns={"x": 0, "y": 1}))
    for problem in problems:
        assert "uniform_acceleration" not in problem.labels.get("excluded", {})
        point, fit, _ = fitted(problem, "uniform_acceleration")
        assert point["uniform_acceleration.x"] == pytest.approx(0.5, abs=0.1) and fit < 0.045
        assert "magnus" in {c.name for c in problem.candidates}


def test_declared_effects_and_the_model_after(tmp_path):
    folder = write(tmp_path, {"feather": Forces(drag_quadratic=0.04)}, model={"gravity": [0, -9.81, 0], "free": ["gravity"]}, nuisances={})
    (problem,) = track_problems(folder)
    assert [p.name for p in problem.declared] == ["gravity"] and "gravity" not in {c.name for c in problem.candidates}
    content = yaml.safe_load((folder / "track.yaml").read_text())
    content["model"] = problem.model_after({"gravity": 9.8, "drag_quadratic.k": 0.04}, ["drag_quadratic"])
    assert content["model"] == {"gravity": [0.0, -9.8, 0.0], "effects": {"drag_quadratic.k": 0.04}, "free": ["gravity"]}
    (folder / "track.yaml").write_text(yaml.safe_dump(content, sort_keys=False))
    (again,) = track_problems(folder)
    expected = problem.predict([{"gravity": 9.8, "drag_quadratic.k": 0.04}, {"gravity": 9.8, "drag_quadratic.k": 0.0}], 0)
    np.testing.assert_allclose(again.predict([{}, {"drag_quadratic.k": 0.0}], 0), expected, atol=1e-6)
    assert np.abs(expected[0] - expected[1]).max() > 0.3


def test_points_of_a_batch_do_not_see_each_other(tmp_path):
    (problem,) = track_problems(write(tmp_path, {"stone": Forces()}))
    points = [{}, {"drag_linear.k": 0.2}, {"gravity.g": -0.5, "position_force.k": 0.1, "position_force.y": 40.0}]
    points.append({"time_force.y0": 0.3, "time_force.y3": -0.3, "uniform_acceleration.y": 0.1, "added_mass.c": 0.002})
    for n in (0, 1):
        whole = problem.predict(points, n)
        for i, point in enumerate(points):
            np.testing.assert_allclose(problem.predict([point], n)[0], whole[i], atol=1e-4)


def test_spin_gives_a_coefficient(tmp_path):
    w = 0.02 * np.array([0.0, 0.0, 20.0])
    folder = write(tmp_path, {"ball": Forces(magnus=w)}, columns={"x": 0, "y": 1})
    text = yaml.safe_load((folder / "track.yaml").read_text())
    for recording in text["recordings"]:
        recording["spin"] = [0, 0, 20.0]
    (folder / "track.yaml").write_text(yaml.safe_dump(text))
    (problem,) = track_problems(folder)
    point, fit, _ = fitted(problem, "magnus")
    assert point["magnus.coefficient"] == pytest.approx(0.02, rel=0.15) and fit < 0.045


def test_a_hand_that_holds_before_a_throw_is_no_force(tmp_path):
    """Its first frames say nothing of the velocity, which is far outside of what gravity could make of them."""
    t, x0, v0 = np.arange(0, 1.0, 1 / 60), np.array([[0.0, 1.2, 0.0]]), np.array([[4.0, 3.0, 0.0]])
    seen = fly(t, x0, v0, np.array([0.15]), Forces(gravity=(0.0, -9.81, 0.0)))[0][:, :2]
    seen = seen + 0.004 * np.random.default_rng(0).standard_normal(seen.shape)
    np.savetxt(tmp_path / "a.csv", np.column_stack([t + 12.3, seen]), delimiter=",", header="t,x,y", comments="")
    entry = {"name": "a", "body": "ball", "file": "a.csv", "role": "fit", "columns": {"t": "t", "x": "x", "y": "y"}}
    content = {"format": "neuido-track/1", "name": "throw", "model": {"gravity": [0, -9.81, 0]}, "nuisances": {"release_time": 0.2},
               "bodies": {"ball": {}}, "recordings": [entry]}  # fmt: skip
    (tmp_path / "track.yaml").write_text(yaml.safe_dump(content))
    problem = TrackProblem(read_tracks(tmp_path), "ball")
    left = problem.predict([{}], 0)[0] - problem.recordings[0].y
    assert np.sqrt(np.mean(left**2)) < 0.005
    assert problem.nuisances_of({}, 0)["release_time:a"] == pytest.approx(0.15, abs=0.005)


def test_frames_after_the_landing_are_left_out(tmp_path):
    folder = write(tmp_path, {"stone": Forces()}, impact=True)
    tracks = read_tracks(folder)
    assert [len(flight_of(track, tracks).t) for track in tracks.recordings] == [len(T) - 2] * 2
    assert [len(r.y) for r in track_problems(folder)[0].recordings] == [43, 43 - math.ceil(0.4 * 43)]


def test_tracking_error_without_a_model():
    rng = np.random.default_rng(3)
    series = []
    for _ in range(20):
        slow = np.zeros(45)
        for i in range(1, 45):
            slow[i] = math.exp(-1 / 3) * slow[i - 1] + 0.1 * math.sqrt(1 - math.exp(-2 / 3)) * rng.standard_normal()
        series.append((T, 40 - 4.9 * T**2 + 0.3 * T**3 + slow + 0.05 * rng.standard_normal(45)))
    found = correlation(series)
    assert 0.04 < found.sigma < 0.09 and 0.04 < found.amplitude < 0.12 and 0.03 < found.time < 0.6
    quiet = correlation([(T, 40 - 4.9 * T**2)])
    assert quiet.sigma < 1e-6 and quiet.amplitude < 1e-6


@pytest.mark.parametrize(("body", "most", "least"), [("bowling-ball", 1.05, 0.95), ("whiffle-ball-2", 0.2, 0.0)])
def test_bridge(data_root, body, most, least):
    """Drag explains a light ball's second drop and does nothing for a bowling ball's."""
    problem = TrackProblem(read_tracks(data_root / "measured" / "bridge-balls"), body)
    before = problem.error(problem.predict([{}], 1)[0] - problem.recordings[1].y, 1)
    after = fitted(problem, "drag_quadratic")[2]
    assert least * before <= after <= most * before


def test_a_frame_far_from_its_neighbours_is_left_out_and_told(tmp_path):
    source = write(tmp_path, {"stone": Forces()})
    rows = np.loadtxt(source / "stone-fit.csv", delimiter=",", skiprows=1)
    rows[20, 1] += 3.0
    np.savetxt(source / "stone-fit.csv", rows, delimiter=",", header="t,y", comments="")
    (problem,) = track_problems(source)
    assert [len(r.y) for r in problem.recordings] == [44, 27]
    assert problem.labels["unseen"] == "Frames far from those before and after were left out: 1 of stone-fit."
    left = [problem.error(problem.predict([{}], n)[0] - problem.recordings[n].y, n) for n in (0, 1)]
    assert left[0] < 0.04 and left[1] < 3 * problem.recordings[1].noise


@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_a_bounce_and_a_swing_of_few_frames_have_no_strays(noise):
    t = np.arange(120) / 60
    bounce = np.abs(np.sin(3.0 * t)) * 0.8 ** np.floor(3.0 * t / np.pi)
    swing = np.sin(2 * np.pi * np.arange(120) / 4 + 0.3)
    for x in (swing, bounce):
        seen = np.column_stack([x, x]) + noise * np.random.default_rng(0).standard_normal((120, 2))
        assert not strays(t, seen, max(noise, 1e-3)).any()
    seen[[3, 60, 117], 1] += 0.3
    assert np.flatnonzero(strays(t, seen, max(noise, 1e-3))).tolist() == [3, 60, 117]
