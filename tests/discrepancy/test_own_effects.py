"""A diagnosis of arrays, and candidates of one's own."""

import json

import numpy as np
import pytest
import yaml

from neuido import OwnEffect, diagnose
from neuido.errors import UserError
from tests.discrepancy import made

GRAVITY = {"gravity": [0.0, -9.81, 0.0]}
T = np.linspace(0, 0.6, 40)


def drop(jerk: float = -2.4) -> dict:
    y = 2.0 - 0.5 * 9.81 * T**2 + jerk / 6 * T**3 + 1e-3 * np.random.default_rng(0).standard_normal(40)
    return {"t": T, "y": y, "noise": 1e-3}


def ramp(size: float) -> dict[str, float]:
    return {"time_force.interval": 0.15} | {f"time_force.y{k}": size * 0.15 * k for k in range(5)}


LIFT = OwnEffect("rising_lift", "jerk", "m/s^3", 1.0, -20.0, 20.0, ramp)


def test_a_candidate_of_ones_own_is_named_and_stays_in_the_model(tmp_path):
    found = diagnose({"drop": drop()}, model=GRAVITY, candidates=[LIFT], effects=["drag_linear"], draws=39, out=tmp_path / "out")
    (effect,) = found.effects
    assert (effect.name, effect.unit) == ("rising_lift", "m/s^3")
    assert effect.interval[0] < -2.4 < effect.interval[1]
    assert found.summary().startswith("The model lacks rising lift: jerk = ")
    own = yaml.safe_load(found.model_after.read_text())["effects"]
    assert own["time_force.y4"] == pytest.approx(0.6 * effect.value) and not any("rising" in key for key in own)
    assert (
        diagnose({"drop": drop()}, model=yaml.safe_load(found.model_after.read_text()), effects=["drag_linear"], draws=39).answer == "none"
    )


def test_a_candidate_of_ones_own_that_is_absent_is_not_named():
    found = diagnose({"drop": drop(0.0)}, model=GRAVITY, candidates=[LIFT], effects=["drag_linear"], draws=39)
    assert (found.answer, found.effects) == ("none", ())


@pytest.mark.slow
def test_arrays_have_the_answer_of_their_folder(tmp_path):
    made.material_test(tmp_path / "rubber")
    content = yaml.safe_load((tmp_path / "rubber" / "test.yaml").read_text())
    data = {}
    for test in content["tests"]:
        stretch, stress = np.loadtxt(tmp_path / "rubber" / test["file"], delimiter=",", skiprows=1).T
        data[test["name"]] = {"stretch": stretch, "nominal_stress": stress, "mode": test["mode"], "role": test["role"]}
    options = {"effects": "strain_stiffening", "draws": 39, "device": "cpu"}
    by_folder, by_arrays = (diagnose(tmp_path / "rubber", **options), diagnose(data, model=content["model"], **options))
    contents = [json.loads((found.folder / "diagnosis.json").read_text()) for found in (by_folder, by_arrays)]
    for c in contents:
        for key in ("experiment", "seconds", "work"):
            c.pop(key)
    assert contents[0] == contents[1]
    assert contents[0]["recordings"]["uniaxial"]["axis"] == {"label": "stretch", "unit": "1"}


@pytest.mark.parametrize(
    ("data", "options", "word"),
    [
        ({}, {"model": GRAVITY}, "recording"),
        ({"a": {"t": T, "y": T}}, {}, "model"),
        ({"a": {"t": T, "y": T[:-1]}}, {"model": GRAVITY}, "one length"),
        ({"a": {"q": T}}, {"model": GRAVITY}, "no columns"),
        ({"../a": {"t": T, "y": T}}, {"model": GRAVITY}, "name of a recording"),
        ({"a": {"t": T, "y": T}}, {"model": GRAVITY, "scene": {"grid": 8}}, "scene"),
        ({"a": {"volume": T}}, {"model": GRAVITY}, "scene"),
        ({"a": {"t": T, "y": T, "colour": 1}}, {"model": GRAVITY}, "colour"),
    ],
)
def test_arrays_that_say_too_little_are_refused(data, options, word):
    with pytest.raises(UserError, match=word):
        diagnose(data, **options)


@pytest.mark.parametrize(
    ("changed", "word"),
    [
        ({"name": "drag_linear"}, "library"),
        ({"name": "a b"}, "words"),
        ({"low": 0.5}, "zero"),
        ({"start": 0.0}, "start"),
        ({"acts_as": lambda size: {"wind.x": size}}, "wind"),
    ],
)
def test_candidates_that_say_too_little_are_refused(changed, word):
    given = {"name": "rising_lift", "parameter": "jerk", "unit": "1", "start": 1.0, "low": -2.0, "high": 2.0, "acts_as": ramp} | changed
    with pytest.raises(UserError, match=word):
        OwnEffect(**given).candidate()


def test_other_objects_are_no_candidates():
    with pytest.raises(UserError, match="OwnEffect"):
        diagnose({"drop": drop()}, model=GRAVITY, candidates=["lift"])
    with pytest.raises(UserError, match="name of its own"):
        diagnose({"drop": drop()}, model=GRAVITY, candidates=[LIFT, LIFT])
