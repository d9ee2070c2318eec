"""diagnosis.json as its contract has it, predictions that survive a kill, and files that appear whole."""

import json
import math

import numpy as np
import pytest
import yaml

from neuido.discrepancy import store
from neuido.discrepancy.inference.search.attribution import diagnose
from neuido.discrepancy.problems.problem import Candidate, Parameter, Problem, Recording
from neuido.discrepancy.report import answer, answer_content, diagnosis_format

T = np.linspace(0.0, 1.0, 40)


class Curve(Problem):
    """y = a t + (1 / inverse - 0.5) t^3 beyond a threshold, or + k t^2: two candidates on two recordings."""

    def __init__(self, truth: dict[str, float], seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        k = Parameter("drag_linear.k", "1/s", 0.0, 0.3, 0.0, 20.0)
        c = Parameter("gravity.g", "m/s^2", 0.0, 0.3, -20.0, 20.0)
        candidates = (Candidate("drag_linear", (k,), ({k.name: 0.3},), "flight"), Candidate("gravity", (c,), ({c.name: 0.3},), "flight"))
        super().__init__("curve", "rmse", "m", (Parameter("young", "Pa", 1.0, 0.1, 0.1, 10.0, log=True),), (), candidates, ())
        made = []
        for i, role in enumerate(("fit", "fit", "held_out")):
            made.append(Recording(f"r{i}", role, np.empty(len(T)), 0.01, np.zeros(len(T), int), T))
        object.__setattr__(self, "recordings", tuple(made))
        for i, r in enumerate(made):
            object.__setattr__(r, "y", self.predict([truth], i)[0] + 0.01 * rng.standard_normal(len(T)))

    def predict(self, points, recording, setting=0):
        speed = 1.0 + recording
        rows = [
            p.get("young", 1.0) * speed * T - p.get("drag_linear.k", 0.0) * speed * T**2 + p.get("gravity.g", 0.0) * np.sin(9 * T)
            for p in points
        ]
        return np.array(rows).reshape(len(points), len(T))

    def model_after(self, values, effects):
        return {"young": values["young"], "effects": {k: v for k, v in values.items() if k.split(".")[0] in effects}}


@pytest.fixture(scope="module")
def found():
    return diagnose(Curve({"young": 1.5, "drag_linear.k": 0.8}), draws=39)


@pytest.fixture(scope="module")
def written(found, tmp_path_factory):
    out = tmp_path_factory.mktemp("answer")
    answer.write(out, [(found, 1.5)], kind="experiment", device="cpu")
    return out


def test_content_is_the_contract(written):
    content = json.loads((written / "diagnosis.json").read_text())
    keys = {
        "format",
        "experiment",
        "answer",
        "effects",
        "declared",
        "after",
        "error",
        "rejected",
        "next_experiment",
        "seconds",
        "device",
        "version",
    }
    assert keys <= set(content)
    assert content["format"] == "neuido-diagnosis/2"
    (effect,) = content["effects"]
    assert {"name", "class", "parameters", "p_value", "where"} <= set(effect)
    assert effect["name"] == effect["class"][0] == "drag_linear"
    k = effect["parameters"]["k"]
    assert k["unit"] == "1/s"
    assert k["interval90"][0] < 0.8 < k["interval90"][1]
    error = content["error"]
    assert error["measure"] == "rmse"
    assert set(error["after"]["by_recording"]) == {"r0", "r1", "r2"}
    parts = [error["before"]["by_recording"][n] for n in ("r0", "r1")]
    assert error["before"]["fit"] == pytest.approx(math.sqrt(np.mean(np.square(parts))))
    assert error["before"]["held_out"] == error["before"]["by_recording"]["r2"]
    assert error["noise_floor"] == pytest.approx(0.01)
    assert content["declared"]["young"]["value"] != content["after"]["young"]["value"]
    assert content["after"]["young"]["value"] == pytest.approx(1.5, rel=0.02)
    assert [r["name"] for r in content["rejected"]] == ["gravity"]
    assert all(r["reason"] for r in content["rejected"])


def test_content_follows_the_schema_and_tells_what_was_weighed(written):
    content = diagnosis_format.read(written / "diagnosis.json")
    assert content["kind"] == "experiment" and content["words"][0].startswith("The model lacks linear air drag: k = ")
    assert content["effects"][0]["title"] == "linear air drag" and content["effects"][0]["step"] == 1
    first, *others = content["models"]
    assert (first["name"], first["verdict"]) == ("drag_linear", "named")
    assert all(m["verdict"] in ("rejected", "weighed") and m["error_ratio"] < first["error_ratio"] for m in others)
    assert {m["name"] for m in content["models"]} <= {"drag_linear", "gravity"}
    assert content["chance"][0]["p_value"] == content["effects"][0]["p_value"] and content["chance"][0]["error_ratio95"] >= 1
    assert content["work"]["simulations"] == sum(own["simulations"] for own in content["work"]["by_step"].values()) > 0
    assert {name: r["role"] for name, r in content["recordings"].items()} == {"r0": "fit", "r1": "fit", "r2": "held_out"}
    assert "The model lacks linear air drag" in (written / "report.html").read_text()


def test_model_and_trace(found, written):
    model = yaml.safe_load((written / "model_after.yaml").read_text())
    assert model["effects"]["drag_linear.k"] == pytest.approx(0.8, rel=0.05)
    trace = json.loads((written / "trace.json").read_text())
    first = trace["rounds"][0]
    assert len(first["null"]["sample"]) == 39
    assert first["chosen"] == "drag_linear"
    for t, own in zip(first["trials"], found.rounds[0].trials, strict=True):
        assert t["gain"] == own.gain
        assert len(t["mean_squares"]) == len(trace["parts"]) == len(first["noise"]) == 3
    assert sum(part["rows"] for part in trace["parts"]) == 120


def test_null_has_reasons_and_no_effects(tmp_path):
    d = diagnose(Curve({"young": 1.5}), draws=39)
    answer.write(tmp_path, [(d, 0.0)], kind="experiment", device="cpu")
    content = json.loads((tmp_path / "diagnosis.json").read_text())
    assert (content["answer"], content["effects"], content["next_experiment"]) == ("none", [], None)
    assert {r["name"] for r in content["rejected"]} == {"drag_linear", "gravity"}
    assert content["error"]["before"] == content["error"]["after"]


def test_figures_that_people_use(found):
    own = {"inverse": {"value": 2e-4, "unit": "1/Pa", "interval90": [1.6e-4, 2.5e-4]}}
    made = answer_content._derived(found, "yield", own)
    assert made["inverse"] == own["inverse"]
    assert made["yield_stress"]["value"] == pytest.approx(5000.0)
    assert made["yield_stress"]["interval90"] == pytest.approx([4000.0, 6250.0])
    ball = {
        k: {"value": v, "unit": "m", "interval90": [v - 0.01, v + 0.01]}
        for k, v in {"cx": 0.1, "cy": 0.0, "cz": -0.1, "radius": 0.08}.items()
    }
    ball["log_ratio"] = {"value": math.log(10), "unit": "1", "interval90": [math.log(8), math.log(12)]}
    made = answer_content._derived(found, "stiffness_gradient", ball)
    assert made["ratio"]["value"] == pytest.approx(10.0)
    assert made["ratio"]["interval90"] == pytest.approx([8.0, 12.0])
    assert made["centre"]["value"] == [0.1, 0.0, -0.1]


def test_figures_that_are_not_finite_become_null(tmp_path):
    answer.write_json(
        tmp_path / "a.json", answer_content.plain({"a": np.float32(np.nan), "b": [np.int64(3), math.inf], "c": np.bool_(True)})
    )
    assert json.loads((tmp_path / "a.json").read_text()) == {"a": None, "b": [3, None], "c": True}
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]


class Interrupted(Exception):
    pass


class Dying(Curve):
    """Dies after so many calls."""

    left = 10**9

    def predict(self, points, recording, setting=0):
        self.__dict__["left"] = self.left - 1
        if self.left < 0:
            raise Interrupted
        return super().predict(points, recording, setting)


@pytest.mark.parametrize("calls", [1, 5, 12, 20])
def test_interrupted_diagnosis_ends_the_same(found, tmp_path, calls):
    dying = Dying({"young": 1.5, "drag_linear.k": 0.8})
    dying.__dict__["left"] = calls
    with pytest.raises(Interrupted):
        diagnose(store.CachedProblem(dying, tmp_path), draws=39)
    again = store.CachedProblem(Curve({"young": 1.5, "drag_linear.k": 0.8}), tmp_path)
    d = diagnose(again, draws=39)
    assert again.found >= calls
    assert d.after == found.after
    assert answer.trace(d) == answer.trace(found)


def test_store_is_exact_and_bounded(tmp_path):
    problem = Curve({"young": 1.5})
    plain = problem.predict([{"young": 1 / 3}], 0)
    small = store.CachedProblem(problem, tmp_path / "a", limit=plain.nbytes)
    np.testing.assert_array_equal(small.predict([{"young": 1 / 3}], 0), plain)
    small.predict([{"young": 2 / 3}], 0)
    assert len(list((tmp_path / "a").iterdir())) == 1  # the second one no longer fits
    np.testing.assert_array_equal(small.predict([{"young": 1 / 3}], 0), plain)
    assert (small.found, small.computed) == (1, 2)
    (path,) = (tmp_path / "a").iterdir()
    path.write_bytes(path.read_bytes()[:-8])  # cut short: computed again
    np.testing.assert_array_equal(small.predict([{"young": 1 / 3}], 0), plain)
    assert small.computed == 3


def test_store_tells_points_recordings_settings_and_orders_apart():
    a, b = {"young": 1.0}, {"young": 1.0 + 1e-15}
    keys = {store._key(p, n, s) for p in ([a], [b], [a, b], [b, a]) for n in (0, 1) for s in (0, 1)}
    assert len(keys) == 16


def test_plan_knows_the_data_and_the_options(tmp_path):
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "a.csv").write_text("1")
    out = tmp_path / "in" / "out"
    plan = store.plan_of(tmp_path / "in", {"seed": 0}, out=out)
    out.mkdir()
    (out / "log.csv").write_text("x")
    assert store.plan_of(tmp_path / "in", {"seed": 0}, out=out) == plan
    assert store.plan_of(tmp_path / "in", {"seed": 1}, out=out) != plan
    (tmp_path / "in" / "a.csv").write_text("2")
    assert store.plan_of(tmp_path / "in", {"seed": 0}, out=out) != plan


def test_workplace_of_another_plan_goes(tmp_path):
    first = store.workplace(tmp_path, "aa", resume=True)
    (first / "x.npy").write_text("x")
    assert (store.workplace(tmp_path, "aa", resume=True) / "x.npy").exists()
    assert not (store.workplace(tmp_path, "aa", resume=False) / "x.npy").exists()
    (first / "x.npy").write_text("x")
    store.workplace(tmp_path, "bb", resume=True)
    assert not first.exists()
    store.clear(tmp_path)
    assert list(tmp_path.iterdir()) == []
