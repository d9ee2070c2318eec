"""A declared model that cannot run is refused in the words of its simulator, with the factor that would let it run."""

import pytest
import yaml

from neuido.data.measured.experiment import read_experiment
from neuido.discrepancy.inference.attribution import diagnose
from neuido.discrepancy.inference.least_squares import Covariance, NotFinite
from neuido.discrepancy.problems.body import body_problem
from neuido.errors import UserError


def test_columns_that_are_not_finite_never_reach_linear_algebra():
    import numpy as np

    with pytest.raises(NotFinite):
        Covariance.of(1.0, np.array([[1.0], [np.nan]]))


def test_the_line_of_a_step_that_is_too_long_has_a_factor_that_lets_it_run(data_root):
    folder = data_root / "cases" / "faults" / "cases" / "young-8e+06"
    if not folder.is_dir():
        pytest.skip("the cases of faults are not here")
    problem = body_problem(read_experiment(folder), device="cpu")
    with pytest.raises(UserError, match=r"above the limit .*discretisation\.dt times") as refused:
        diagnose(problem, draws=19, seconds=60)
    factor = float(str(refused.value).split("discretisation.dt times ")[1].split(",")[0])
    content = yaml.safe_load((folder / "experiment.yaml").read_text())
    assert 0 < factor < 1 and content["discretisation"]["dt"] > 0
    from dataclasses import replace

    experiment = read_experiment(folder)
    shorter = tuple(replace(r, scene=replace(r.scene, dt=factor * r.scene.dt)) for r in experiment.recordings)
    assert body_problem(replace(experiment, recordings=shorter), device="cpu").margin({}) >= 0
