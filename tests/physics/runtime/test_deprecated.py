"""Renamed options: the old name works and warns."""

import warnings

import pytest
import torch

from neuido.physics.fem.finite_elements import FiniteElements
from neuido.physics.laws.classical import FixedCorotated
from neuido.physics.mpm.simulator import Simulator
from neuido.physics.runtime.deprecated import renamed_option
from neuido.types import Body, Scene


def test_only_the_old_name_warns():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert renamed_option("new", 3, "old", None) == 3
    with pytest.warns(DeprecationWarning, match="old is deprecated; give new"):
        assert renamed_option("new", True, "old", False) is False


def test_old_names_of_rollout_options_have_the_effect_of_the_new_ones():
    axis = torch.linspace(0.4, 0.6, 4)
    x = torch.cartesian_prod(axis, axis, axis)
    body, scene, law = Body(x, torch.zeros_like(x), torch.full((64,), 3e-4)), Scene(cells=16), FixedCorotated(1e9, 0.3)
    with pytest.warns(DeprecationWarning, match="keep is deprecated; give store"):
        simulator = Simulator(scene, body, device="cpu", keep="all")
    assert simulator.setup.keep_grid and not Simulator(scene, body, device="cpu", store="state").setup.keep_grid
    with pytest.warns(DeprecationWarning, match="lenient is deprecated; give nan_on_failure"):
        assert simulator.rollout(2, law, lenient=True).x[-1].isnan().all()
    elements = FiniteElements(scene, body, device="cpu", max_inner_steps=1)
    with pytest.warns(DeprecationWarning, match="lenient is deprecated; give nan_on_failure"):
        assert elements.rollout(2, law, lenient=True).x[-1].isnan().all()
    soft, elements = FixedCorotated(1e4, 0.3), FiniteElements(scene, body, device="cpu")
    start = elements.state._replace(F=1.02 * elements.state.F)
    with pytest.warns(DeprecationWarning, match="finer is deprecated; give inner_factor"):
        old = elements.rollout(5, soft, state=start, finer=3)
    new, plain = (FiniteElements(scene, body, device="cpu").rollout(5, soft, state=start, inner_factor=n) for n in (3, 1))
    assert torch.equal(old.x, new.x) and not torch.equal(new.x, plain.x)
