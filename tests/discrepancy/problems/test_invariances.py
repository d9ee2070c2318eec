"""What does not change the motion changes no answer: real flights with another clock, unit, axis, order, sampling or with a repeat."""

import numpy as np
import pytest
import yaml

from neuido.discrepancy.inference.search.attribution import diagnose
from neuido.discrepancy.problems.tracks.track_problem import track_problems
from neuido.discrepancy.workflow import restricted

EFFECTS = "drag_linear,drag_quadratic,added_mass"
KNOWN = {
    "bowling-ball": set(),
    "golf-ball": set(),
    "whiffle-ball-1": {"drag_linear", "drag_quadratic"},
    "volleyball": {"drag_linear", "drag_quadratic"},
}
"""What a ball may lack: drag that a heavy and small one does not show."""


def written(source, target, body, *, origin=0.0, unit=1.0, axis="y", backwards=False, every=1, twice=False):
    """Write one body of the measured folder in another way."""
    content = yaml.safe_load((source / "track.yaml").read_text())
    target.mkdir()
    recordings = [r for r in content["recordings"] if r["body"] == body]
    if twice:
        recordings.append({**recordings[0], "name": "again"})
    for entry in recordings:
        rows = np.loadtxt(source / entry["file"], delimiter=",", skiprows=1)[::every]
        entry["file"] = f"{entry['name']}.csv"
        rows = rows * [1.0, 1 / unit] + [origin, 0.0]
        np.savetxt(target / entry["file"], rows, delimiter=",", header="t_s,height", comments="", fmt="%.12g")
        entry["columns"] = {"t": "t_s", axis: "height"}
        entry["scale"] = {axis: unit}
    content["model"]["gravity"] = [-9.81 if a == axis else 0.0 for a in "xyz"]
    content["bodies"] = {body: content["bodies"][body]}
    content["recordings"] = recordings[::-1] if backwards else recordings
    (target / "track.yaml").write_text(yaml.safe_dump(content))
    return target


def answered(folder):
    """The answer and all effects of its classes; the drag that such a ball has is not excluded where it is not named."""
    (problem,) = track_problems(folder)
    found = diagnose(restricted(problem, EFFECTS), draws=39, most=1)
    names = {t.candidate.name for r in found.rounds if r.chosen is not None for t in r.members} if found.effects else set()
    ordinary = problem.labels["ordinary"].get("drag_quadratic.k", 0.0)
    assert all(one.up_to is None or one.up_to > ordinary for one in found.power if one.name == "drag_quadratic")
    return found.answer, names | {t.candidate.name for t in found.effects}


@pytest.mark.slow
@pytest.mark.parametrize("body", KNOWN)
def test_no_answer_changes(data_root, tmp_path, body):
    source = data_root / "measured" / "bridge-balls"
    answer, names = answered(written(source, tmp_path / "plain", body))
    assert names <= KNOWN[body] and bool(names) == bool(KNOWN[body])
    others = {
        "clock": {"origin": 1.7e6}, "unit": {"unit": 0.001}, "axis": {"axis": "z"}, "order": {"backwards": True},
        "thinned": {"every": 2}, "twice": {"twice": True},
    }  # fmt: skip
    for name, options in others.items():
        again, same = answered(written(source, tmp_path / name, body, **options))
        if name in ("thinned", "twice"):  # fewer data or more: the members of a class may differ
            assert bool(same) == bool(names) and same <= KNOWN[body], name
        else:
            assert (again, same) == (answer, names), name
