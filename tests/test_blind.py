"""The blind benchmark: an even plan, a scoring that gives each answer what it deserves, and what a lesser machinery would answer."""

import importlib.util
import json
import math
import sys
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml

from neuido.data.undeclared import Case
from neuido.errors import UserError

FOLDER = Path(__file__).parents[1] / "benchmarks"
if not (FOLDER / "blind.py").is_file():
    pytest.skip("the benchmarks do not come with the installed package", allow_module_level=True)


def load(name: str):
    sys.path.insert(0, str(FOLDER))
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


scores = load("blind_scores")
blind = load("blind")
calibrate = load("calibrate")


def effect(name, value=1.0, interval=(0.8, 1.2), others=(), key="k"):
    return {"name": name, "class": [name, *others], "parameters": {key: {"value": value, "interval90": list(interval)}}}


def answer(*effects, kind="effect", before=0.1, after=0.01, young=(0.9e5, 1.1e5)):
    return {
        "answer": kind,
        "effects": list(effects),
        "after": {"young": {"value": 1e5, "interval90": list(young)}},
        "error": {"noise_floor": 0.006, "discretisation_floor": 0.008, "before": {"held_out": before}, "after": {"held_out": after}},
        "seconds": 10.0,
    }


def truth(*kinds, value=1.0, outside=False, nuisances=False):
    entries = [
        {"kind": kind, "diagnosis_names": [] if outside else [kind], "parameters": {"k": value}, "sizes": ["k"], "outside_library": outside,
         "near": ["drag_quadratic"] if outside else []}
        for kind in kinds
    ]  # fmt: skip
    rows = [{"name": "take1", "role": "fit", "reference_rms_m": 0.0} | ({"separation_rms_m": 0.05} if kinds else {})]
    key = {"undeclared": entries, "material": {"young": 1e5}, "noise": 0.001, "recordings": rows, "solver": "same"}
    return key | ({"nuisances": {"take1": {"time_base": 0.003}}} if nuisances else {})


def test_one_effect():
    row = scores.score(truth("drag_linear"), answer(effect("drag_linear", 1.1)))
    assert row["exact"] and row["in_class"] and row["class_size"] == 1 and row["group"] == "one"
    assert row["parameter_error"] == pytest.approx(0.1) and (row["covered"], row["intervals"]) == (2, 2)
    assert row["floor"] == pytest.approx(0.01) and row["snr"] == pytest.approx(50)
    off = scores.score(truth("drag_linear"), answer(effect("drag_linear", 1.5, (1.4, 1.6)), young=(0.7e5, 0.8e5)))
    assert off["parameter_error"] == pytest.approx(0.5) and off["covered"] == 0
    member = scores.score(truth("drag_linear"), answer(effect("viscosity_shear", others=["drag_linear"]), kind="class"))
    assert member["in_class"] and not member["exact"] and math.isnan(member["parameter_error"]) and member["intervals"] == 0
    wrong = scores.score(truth("drag_linear"), answer(effect("viscosity_shear")))
    assert not wrong["in_class"] and wrong["found"] == 0


def stored(*fits, noise=0.01):
    """A case of one part with fits, each the keys of its effects, its point, and the mean square that it leaves."""
    made = [SimpleNamespace(effects=effects, point=point, errors=(error,), finished=None) for effects, point, error in fits]
    parts, recordings = ((0, True, 10, "take1"),), (("take1", "fit", 10, noise, "stated"),)
    work = {"fits": {"effort": 3.0, "simulations": 2, "reused": 0, "seconds": 1.0}}
    return SimpleNamespace(judged=(SimpleNamespace(fits=made),), parts=parts, recordings=recordings, work=work)


def decision(answer, *named):
    return SimpleNamespace(answer=answer, effects=named, classes=tuple((name,) for name in named))


def test_search_and_decision_are_reported_apart():
    key, far = truth("drag_linear"), (("viscosity_shear",), {"viscosity_shear.k": 1.0}, 0.09)
    live = answer(effect("viscosity_shear"))
    cases = {
        "reached, not named": ((("drag_linear",), {"drag_linear.k": 1.1}, 0.04), True, True),
        "tried, astray": ((("drag_linear",), {"drag_linear.k": 3.0}, 0.04), True, False),
        "at the noise, whatever its size": ((("drag_linear",), {"drag_linear.k": 3.0}, 1.1e-4), True, True),
        "never tried": ((("drag_linear", "yield"), {"drag_linear.k": 1.0}, 1e-4), False, False),
    }
    rows = []
    for fit, tried, reached in cases.values():
        row = scores.replayed(key, live, stored(far, fit), decision("effect", "viscosity_shear"))
        assert (row["tried"], row["reached"], row["named"], row["same"]) == (tried, reached, False, True)
        rows.append(row)
    right = scores.replayed(key, live, stored(far, cases["reached, not named"][0]), decision("effect", "drag_linear"))
    assert right["named"] and not right["same"]
    table = scores.recall([*rows, right])
    assert table["one effect: fitted near the optimum (search recall)"].startswith("3 of 5")
    assert table["one effect: of these named (decision accuracy)"].startswith("1 of 3")
    assert table["replay equal to the diagnosis"].startswith("4 of 5") and table["two effects: true effects fitted"] == "none made"
    null = scores.replayed(truth(), answer(kind="none"), stored(far), decision("none"))
    assert not null["tried"] and scores.recall([null])["nulls on which an effect is named"].startswith("0 of 1")


def test_what_the_evidence_says_is_scored_beside_the_decision():
    live, key = answer(kind="none"), truth("drag_linear", "yield")

    def row(kind, *sets, cut=False):
        case = SimpleNamespace(facts={"cut": cut, "wrong": []})
        return scores.by_evidence(key, live, case, SimpleNamespace(answer=kind, sets=sets, lead=9.0, p_value=0.05))

    assert row("effect", ("drag_linear", "yield"))["evidence_named"]
    swapped = row("class", ("drag_quadratic", "yield"), ("drag_linear", "yield"), ("softening",))
    assert swapped["evidence_named"] and swapped["evidence_sets"] == "drag_quadratic+yield or drag_linear+yield or softening"
    assert not row("class", ("drag_quadratic", "yield"), ("drag_linear", "softening"))["evidence_named"]
    assert not row("unknown")["evidence_named"] and scores.by_evidence(key, live, None, None)["evidence_answer"] == ""
    cut = row("effect", ("drag_linear", "yield"), cut=True)
    assert cut["evidence_answer"] == "unfinished" and not cut["evidence_named"] and cut["evidence_sets"] == "drag_linear+yield"


def test_one_effect_too_many_or_too_few():
    extra = scores.score(truth("drag_linear"), answer(effect("drag_linear"), effect("yield")))
    assert extra["found"] == 1 and not extra["in_class"] and not extra["exact"]
    half = scores.score(truth("drag_linear", "yield"), answer(effect("yield")))
    assert half["found"] == 1 and not half["in_class"] and half["group"] == "two"
    shared = scores.score(truth("drag_linear", "drag_quadratic"), answer(effect("drag_linear", others=["drag_quadratic"]), effect("yield")))
    assert shared["found"] == 1, "one class does not count for two effects"
    both = scores.score(truth("drag_linear", "yield"), answer(effect("yield"), effect("drag_quadratic", others=["drag_linear"])))
    assert both["found"] == 2 and both["in_class"] and not both["exact"]


def test_named_in_an_answer_that_names_nothing_does_not_count():
    row = scores.score(truth("drag_linear"), answer(effect("drag_linear"), kind="unknown"))
    assert row["found"] == 0 and row["named"] == ""


def test_vectors_and_older_keys():
    key = truth("uniform_acceleration")
    key["undeclared"][0] |= {"parameters": {"a": [3.0, 0.0, 4.0]}}
    del key["undeclared"][0]["sizes"], key["undeclared"][0]["outside_library"]
    found = effect("uniform_acceleration", 3.0, (2, 4), key="x")
    found["parameters"] |= {"y": {"value": 0.5, "interval90": [-1, 1]}, "z": {"value": 4.0, "interval90": [4.1, 5]}}
    row = scores.score(key, answer(found))
    assert row["parameter_error"] == pytest.approx(0.1) and (row["covered"], row["intervals"]) == (3, 4)


def test_summary_counts():
    rows = [scores.score(truth(), answer(kind="none")) for _ in range(9)]
    rows.append(scores.score(truth(nuisances=True), answer(effect("drag_linear"))))
    rows += [scores.score(truth("drag_linear"), answer(effect("drag_linear", 1.2))), scores.score(truth("yield"), answer(kind="none"))]
    rows += [scores.score(truth("dry_drag", outside=True), answer(kind="unknown"))]
    rows += [scores.score(truth("dry_drag", outside=True), answer(effect("drag_linear", others=["drag_quadratic"])))]
    rows += [scores.score(truth("dry_drag", outside=True), answer(effect("yield")))]
    made = scores.summary(rows)
    assert made["false alarms on nulls"] == "1 of 10 (10 %)" and made["of these with wrong nuisances"] == "1 of 1 (100 %)"
    assert made["their 95 % upper bound"] == "39 %"  # Clopper and Pearson, 1 of 10
    assert made["in class"] == "1 of 2 (50 %)" and made["missed (no effect named)"] == "1 of 2 (50 %)"
    assert made["median parameter error"] == "20 %" and made["held-out error, before / after, median"] == "10"
    assert made["outside the library: unknown"] == "1 of 3 (33 %)"
    assert made["outside: a near effect named"] == made["outside: another effect named"] == "1 of 3 (33 %)"
    text = scores.table({"full": made, "other": made})
    assert text.splitlines()[0] == "|  | full | other |" and len(text.splitlines()) == len(made) + 2


def trial(name, fitted, held, score, parameters=1):
    return {"key": name, "name": name, "point": {f"{name}.k": 2.0, "young": 1e5}, "parameters": parameters, "mean_squares": [fitted, held],
            "score": score, "gain": 1.0}  # fmt: skip


def trace(base, *trials, chosen=None, rows=1000):
    parts = [{"name": "take1", "fitted": True, "rows": rows}, {"name": "take2", "fitted": False, "rows": rows}]
    return {"parts": parts, "rounds": [{"mean_squares": [base, base], "trials": list(trials), "chosen": chosen}]}


def test_lesser_machineries():
    given = trace(1.0, trial("drag_linear", 0.98, 0.98, -0.02), trial("yield", 0.97, 4.0, 0.7, parameters=2))
    none, unknown = answer(kind="none"), answer(kind="unknown")
    bic = scores.ablated("plain-bic", none, given)
    assert bic["answer"] == "effect" and bic["effects"][0]["name"] == "yield"  # 2 % of an autocorrelated residual is enough for it
    assert bic["effects"][0]["parameters"] == {"k": {"value": 2.0, "interval90": None}}
    assert scores.score(truth("yield"), bic)["intervals"] == 0
    assert bic["error"]["after"]["held_out"] == pytest.approx(0.1 * 2.0)
    assert scores.ablated("plain-bic", none, trace(1.0, trial("drag_linear", 0.999, 1.0, 0.0)))["answer"] == "none"
    assert scores.ablated("take-smallest-error", none, given)["effects"][0]["name"] == "yield"
    assert scores.ablated("no-unknown", none, given)["answer"] == "none"
    assert scores.ablated("no-unknown", unknown, given)["effects"][0]["name"] == "drag_linear"
    assert scores.ablated("take-smallest-error", none, trace(1.0))["answer"] == "none"
    broken = trace(1.0, {**trial("yield", None, None, 9.0)}, trial("drag_linear", 0.5, 0.5, -0.7))
    assert scores.ablated("plain-bic", none, broken)["effects"][0]["name"] == "drag_linear"


def test_plan_is_even():
    from neuido.data.undeclared.random_effects import KINDS, OUTSIDE

    cases = [case for _, _, case in blind.plan(60, 4, 0)]
    bodies = [case for case in cases if case.measured == "body"]
    counts = Counter(case.kind for case in bodies)
    assert len(bodies) == 60 and counts["none"] == 20 and sum(bool(c.nuisances) for c in bodies) == 10
    assert all(counts[kind] == 1 for kind in OUTSIDE) and all(counts[kind] == 1 for kind in KINDS)
    assert sum("+" in kind for kind in counts) == 5
    assert min(Counter(case.solver for case in bodies).values()) >= 15
    assert blind.plan(60, 4, 0) == blind.plan(60, 4, 0) != blind.plan(60, 4, 1)


@pytest.fixture
def case(tmp_path):
    assert blind.make_one("case-000", 1, Case(measured="track", kind="none"), str(tmp_path / "cases"), "cpu") == ""
    return tmp_path / "cases" / "case-000", tmp_path


def test_a_case_whose_making_fails_leaves_the_others(tmp_path, monkeypatch):
    seeds = []

    def full(seed, *_, **__):
        seeds.append(seed)
        raise UserError("too little moves") if len(seeds) == 1 else RuntimeError("out of memory")

    monkeypatch.setattr(blind, "make_undeclared", full)
    assert blind.make_one("case-000", 7, Case(), str(tmp_path), "cpu") == "RuntimeError: out of memory"
    assert seeds == [7, 100_007], "what is too little is drawn again, what fails is not"


def test_a_case_that_its_solver_does_not_allow_is_made_by_the_suggested_one(tmp_path, monkeypatch):
    solvers = []

    def barred(seed, *_, case, **__):
        solvers.append(case.solver)
        raise UserError("too little moves")

    monkeypatch.setattr(blind, "make_undeclared", barred)
    assert blind.make_one("case-000", 7, Case(kind="strain_stiffening", solver="elements"), str(tmp_path), "cpu") == "too little moves"
    half = blind.ATTEMPTS // 2
    assert solvers == ["elements"] * half + ["same"] * (blind.ATTEMPTS - half)


@pytest.mark.slow
def test_from_a_case_to_its_score(case):
    folder, out = case
    place = out / "answers" / "none" / folder.name
    assert blind.diagnose_one(str(folder), str(place), "none", "cpu", statistics=True) == ""
    text = blind.score_all([folder], out, [])
    assert text.startswith("|  | full | plain-bic | no-unknown | take-smallest-error |")
    key = yaml.safe_load((folder.parent / "keys" / f"{folder.name}.yaml").read_text())
    row = next(line for line in (out / "scores.csv").read_text().splitlines() if ",none," in line)
    assert row.startswith(f"{folder.name},none,{scores.group_of(key)}")
    table = blind.replay_all([folder], out)
    assert "| replay equal to the diagnosis | 1 of 1 (100 %) |" in table
    ((row, found),) = calibrate.cases(out)
    assert (row["case"], row["kind"], row["run"]) == (folder.name, "none", out.name) and row["behind"] >= 0.0
    assert not found[0].effects or row["behind"] > 0.0


def test_a_key_that_was_changed_is_refused(case):
    folder, out = case
    place = out / "answers" / "none" / folder.name
    place.mkdir(parents=True)
    (place / "diagnosis.json").write_text(json.dumps(answer(kind="none")))
    (place / "trace.json").write_text(json.dumps(trace(1.0)))
    assert "of 1" in blind.score_all([folder], out, [])
    key = folder.parent / "keys" / f"{folder.name}.yaml"
    key.write_text(key.read_text() + "\n")
    with pytest.raises(SystemExit, match="not the key"):
        blind.score_all([folder], out, [])


def test_a_case_that_fails_is_scored_as_failed(case):
    folder, out = case
    (folder / "throw-1.csv").write_text("not,a,table\n")
    place = out / "answers" / "none" / folder.name
    assert "UserError" in blind.diagnose_one(str(folder), str(place), "none", "cpu")
    assert "| failed | 1 of 1 (100 %) |" in blind.score_all([folder], out, [])


def test_single_recording_leaves_out_what_is_held_out(case):
    folder, out = case
    left = yaml.safe_load((blind._with_one_recording(folder, out / "one") / "track.yaml").read_text())
    assert {r["role"] for r in left["recordings"]} == {"fit"} and len(left["recordings"]) == 2
