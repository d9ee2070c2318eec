"""Motions of several recordings in one launch are those that each makes by itself."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from neuido.discrepancy.problems import body_launches, rollouts, settings
from neuido.discrepancy.problems.body import BodyProblem, body_problem
from neuido.discrepancy.problems.settings import SETTINGS
from neuido.errors import UserError
from neuido.physics.fem.finite_elements import FiniteElements
from neuido.physics.mpm.simulator import Simulator
from tests.discrepancy import made

CUDA = pytest.param("cuda", marks=[pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")])
FIBRES = {"fibre.c": 3e4, "fibre.azimuth": 0.4, "fibre.elevation": 0.7}
POINTS = [
    {"young": 6e4, "velocity_x:throw": 0.2, "spin_z:drop": 1.5, "spin_y:throw": -2.0},
    {"young": 8e4, "stiffness_gradient.x": 2.0, "viscosity_shear.eta": 4.0},
    {"young": 6e4, **FIBRES, "drag_linear.k": 2.0},
]


@pytest.fixture(scope="module")
def experiment(tmp_path_factory):
    """Bodies of 64 and of 125 particles, the second one turned: fibres and gradients turn with it."""
    path = tmp_path_factory.mktemp("launches")
    first, second = (made.experiment(path / str(side), {}, frames=8, side=side).recordings[i] for i, side in enumerate((4, 5)))
    last = made.experiment(path / "turned", {}, frames=8, side=4).recordings[0]
    # a quarter turn about z keeps the lattice of a cube, so the noise of a particle tells it
    body = last.body
    centre = body.x.mean(dim=0)
    generator = torch.Generator().manual_seed(3)
    uneven = body.x + 0.004 * torch.randn(body.x.shape, generator=generator)
    R = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    turned = replace(last, name="turned", role="held_out", body=body._replace(x=(uneven - uneven.mean(dim=0)) @ R.T + centre))
    straight = replace(first, body=first.body._replace(x=uneven))
    whole = made.experiment(path / "whole", {}, frames=8, side=4)
    return replace(whole, recordings=(straight, second, turned))


@pytest.mark.parametrize("device", ["cpu", CUDA])
@pytest.mark.parametrize("setting", [0, 2, 4, 5], ids=lambda s: SETTINGS[s].name)
def test_recordings_in_one_launch_move_as_alone(setting, device, experiment):
    problem = body_problem(experiment, device=device)
    turns = [problem._turn(n) for n in range(3)]
    assert torch.equal(turns[1], torch.eye(3, dtype=torch.float64)), "another body has no turn"
    assert torch.allclose(turns[2][:2, :2], torch.tensor([[0.0, -1.0], [1.0, 0.0]], dtype=torch.float64), atol=1e-5)
    runs = [(POINTS, 0), (POINTS[:2], 1), (POINTS, 2)]
    for (points, n), frames in zip(runs, problem._move(runs, setting), strict=True):
        assert frames.x.shape == (8, len(points), len(experiment.recordings[n].body.x), 3)
        for s, point in enumerate(points):
            alone = problem._moved(point, n, setting)
            torch.testing.assert_close(frames.x[:, s], alone.x[:, 0], atol=2e-5, rtol=0.0)
    assert float((problem._moved(POINTS[2], 0).x - problem._moved({"young": 6e4}, 0).x).abs().max()) > 1e-3


@pytest.mark.parametrize("setting", [0, 5], ids=lambda s: SETTINGS[s].name)
@pytest.mark.parametrize("stage", [1, 2, 3])
def test_kernels_of_effects_that_are_absent_do_not_move_a_body(stage, setting, experiment, monkeypatch):
    """On a GPU a launch has all effects of its stage, whichever of them its motions have."""
    problem, point, own = body_problem(experiment), {"young": 6e4}, BodyProblem._effects
    always = body_launches.names(problem.candidates, stage)
    assert {body_launches.stage({name: 1.0}) for name in always} == set(range(1, stage + 1))
    alone = problem._moved(point, 0, setting)
    monkeypatch.setattr(BodyProblem, "_effects", lambda self, simulator, full, of, _: own(self, simulator, full, of, always))
    torch.testing.assert_close(body_problem(experiment)._moved(point, 0, setting).x, alone.x, atol=2e-5, rtol=0.0)


def test_fibres_and_gradients_turn_with_the_body(experiment):
    problem = body_problem(experiment)
    full = [POINTS[2], {**POINTS[2], "stiffness_gradient.x": 2.0}]
    effects = problem._effects(problem.simulator((0, 2), 0, 1), full, [0, 2], [])
    R = problem._turn(2).float()
    torch.testing.assert_close(effects.fibre_direction[1], R @ effects.fibre_direction[0])
    assert float((effects.fibre_direction[1] - effects.fibre_direction[0]).abs().max()) > 0.1
    own = problem._effects(problem.simulator((0,), 0, 1), full[1:], [0], [])
    torch.testing.assert_close(effects.stiffness[-64:], own.stiffness, rtol=1e-4, atol=0.0)


@pytest.mark.parametrize("device", ["cpu", CUDA])
def test_what_is_asked_for_at_once_is_answered_as_one_by_one(device, experiment, monkeypatch):
    """In their order, with instruments that need no run and points that no simulation bears; a launch for each setting and kernels."""
    problem = body_problem(experiment, device=device)
    impossible = {"young": 1e12}
    several = [*POINTS, {**POINTS[0], "time_base:throw": 0.01}, impossible]
    asks = [(several, 0, 0), (POINTS[:1], 0, 0), (several, 1, 0), (POINTS, 2, 0), (several[2:], 1, 2), (several[2:], 0, 2), ([], 2, 2)]
    alone = [np.concatenate([np.empty((0, len(problem.recordings[n].y))), *(problem.predict([p], n, s) for p in points)])
             for points, n, s in asks]  # fmt: skip
    counts, rollout = [], Simulator.rollout

    def watched(self, *args, **options):
        counts.append(self.scene_count)
        return rollout(self, *args, **options)

    monkeypatch.setattr(Simulator, "rollout", watched)
    runs = problem._runs(asks)
    for (points, n, _), got, one in zip(asks, problem._in_one_launch(runs), alone, strict=True):
        assert got.shape == (len(points), len(problem.recordings[n].y))
        np.testing.assert_allclose(got, one, atol=2e-5)
        assert [np.isnan(row).any() for row in got] == [point is impossible for point in points]
    stages = {body_launches.stage(point) for point in POINTS}
    assert 1 < len(stages) < len(POINTS) and len(counts) == 2 * len(stages) + 1, "what is impossible is NaN where it is, without a repeat"
    counts.clear()
    possible = [(POINTS, n, s) for s in (0, 1) for n in (0, 1, 2)]
    list(problem._in_one_launch(problem._runs(possible)))
    assert len(counts) == 2 * len(stages)
    counts.clear()
    small = body_problem(experiment, device=device, batch=3)
    list(small._in_one_launch(small._runs(possible)))
    assert len(counts) == 2 * len(POINTS) and max(counts) <= 3


@pytest.mark.parametrize("device", ["cpu", CUDA])
def test_a_launch_computes_no_more_than_its_motions_need(device, experiment, monkeypatch):
    """A history takes three times the work of a body without one, and a viscosity many times the inner steps of finite elements."""
    problem, elements = body_problem(experiment, device=device), settings.SOLVERS[1]
    sizes = ({"viscosity_bulk.zeta": size} for size in np.geomspace(1.0, 1e4, 50))
    viscous = next(point for point in sizes if problem.inner_steps(point, elements) > 4)
    points = [
        {},
        {"drag_linear.k": 1.0},
        {"young": 9e4},
        viscous,
        {"maxwell.ratio": 0.5, "maxwell.time": 0.01},
        {"viscosity_bulk.zeta": 1e5},
    ]
    asked, rollout = [], FiniteElements.rollout

    def watched(self, *args, inner, effects, **options):
        asked.append((self.scene_count, inner, effects.viscosity_bulk is not None, effects.maxwell_ratio is not None))
        return rollout(self, *args, inner=inner, effects=effects, **options)

    monkeypatch.setattr(FiniteElements, "rollout", watched)
    (together,) = problem._in_one_launch(problem._runs([(points, 0, elements)]))
    filled = rollouts.SIZES[1] if device == "cuda" else 2
    assert [count for count, *_ in asked] == [filled, 1, 1, 1] and [kernels for *_, kernels in asked] == [False, False, False, True]
    inner = [n for _, n, *_ in asked]
    assert inner[2] > 2 * max(inner[:2]) and inner[3] <= 2 * inner[0]
    monkeypatch.setattr(FiniteElements, "rollout", rollout)
    assert np.isnan(together[-1]).all(), "what needs more inner steps than it may take is not moved"
    alone = [problem.predict([point], 0, elements)[0] for point in points]
    np.testing.assert_allclose(together, alone, atol=2e-6)
    assert all(n in body_launches.INNER_STEPS for n in inner)


BESIDE = {"fibre.c": {"fibre.azimuth": 0.3, "fibre.elevation": 0.2}, "maxwell.ratio": {"maxwell.time": 0.01}}
LARGE = {"young": 4e6, "viscosity_shear.eta": 2000.0, "fibre.c": 4e6, "maxwell.ratio": 60.0, "stiffness_gradient.x": 20.0}


@pytest.mark.parametrize(("name", "value"), LARGE.items())
def test_the_margin_says_which_points_run(name, value, experiment):
    """It falls with the size of whatever asks for a shorter step, and every recording runs as long as it is above zero."""
    problem, beside = body_problem(experiment), BESIDE.get(name, {})
    sizes = [value * f for f in (0.01, 0.1, 1.0, 3.0)]
    margins = [problem.margin({**beside, name: size}) for size in sizes]
    assert np.all(np.diff(margins) < 0)
    low, high = sizes[0], sizes[-1]
    assert margins[0] > 0 > margins[-1]
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if problem.margin({**beside, name: middle}) > 0 else (low, middle)
    refused = [body_refuses(problem, {**beside, name: size}) for size in (0.999 * low, 1.001 * low)]
    assert refused == [False, True]
    assert problem.margin({}, 1) > problem.margin({}, 0) + 0.5


@pytest.mark.parametrize("name", ["viscosity_shear.eta", "viscosity_bulk.zeta"])
def test_finite_elements_take_no_more_inner_steps_than_they_can_afford(name, experiment):
    """Where a viscosity asks for more they do not run, alone and beside others."""
    problem = body_problem(experiment)
    elements = problem.solvers[1]
    assert problem.margin({}, elements) >= np.log(settings.AFFORDED) - 1e-9
    margins = [problem.margin({name: size}, elements) for size in (1.0, 10.0, 100.0, 1e5)]
    assert np.all(np.diff(margins) < 0) and margins[-1] < 0 < margins[0]
    assert np.isnan(problem.predict([{name: 1e5}], 0, elements)).all()
    first, second = problem.predict([{name: 1e5}, {name: 1.0}], 0, elements)
    assert np.isnan(first).all() and np.isfinite(second).all()


def body_refuses(problem, point) -> bool:
    """Whether a rollout of some recording stops at its step."""
    for n in range(len(problem.measured)):
        try:
            problem._moved(point, n)
        except UserError as error:
            if "above the limit" in str(error):
                return True
    return False


def test_what_fails_in_a_launch_of_finite_elements_fails_alone(experiment, monkeypatch):
    """Others of the same launch are not moved again; what is too stiff for its inner steps is, together and with more of them."""
    problem, setting = body_problem(experiment), settings.SOLVERS[1]
    points = [
        POINTS[0],
        {"young": 1e5, "strain_stiffening.k": 40.0},
        {"young": 1e14},
        POINTS[2],
        {"young": 9e4, "strain_stiffening.k": 40.0},
    ]
    launches, rollout = [], FiniteElements.rollout

    def watched(self, *args, **options):
        launches.append((self.scene_count, options.get("inner_factor", 1)))
        out = rollout(self, *args, **options)
        if options.get("inner_factor", 1) < 2:  # as a motion that pressed the body harder
            scene = self.particles.scene.long()
            out.x[:, (scene == 1) | (scene == 4)] = torch.nan
        return out

    monkeypatch.setattr(FiniteElements, "rollout", watched)
    (frames,) = problem._move([(points, 0)], setting)
    assert launches == [(5, 1), (2, 2)]
    monkeypatch.setattr(FiniteElements, "rollout", rollout)
    assert torch.isnan(frames.x[:, 2]).all(), "more inner steps than there may be"
    for s in (0, 1, 3, 4):
        alone = problem._moved(points[s], 0, setting)
        torch.testing.assert_close(frames.x[:, s], alone.x[:, 0], atol=2e-5 if s in (0, 3) else 2e-3, rtol=0.0)
    with pytest.raises(UserError, match="inner steps of its smallest element"):
        problem._moved(points[2], 0, setting)


NO_MEMORY = (
    torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 MiB."),
    getattr(torch, "AcceleratorError", RuntimeError)("CUDA error: out of memory\nSearch for `cudaErrorMemoryAllocation'"),
    RuntimeError("Failed to allocate 96 bytes on device 'cuda:0'"),
)


@pytest.mark.parametrize("error", NO_MEMORY, ids=["torch", "capture", "warp"])
@pytest.mark.parametrize("most", [2, 1, 0])
@pytest.mark.slow
def test_a_launch_without_memory_is_divided(experiment, monkeypatch, most, error):
    """Until it fits; for one motion that does not, what is kept is given up once, and then it is the user's."""
    problem = body_problem(experiment)
    expected = problem.predict(POINTS[:3], 0)
    simulate, launches = BodyProblem._simulate, []

    def small(self, runs, setting):
        launches.append(sum(len(points) for points, _ in runs))
        if launches[-1] > most:
            raise error
        return simulate(self, runs, setting)

    monkeypatch.setattr(BodyProblem, "_simulate", small)
    (run,) = problem._runs([(POINTS[:3], 0, 0)])
    if most == 0:
        with pytest.raises(UserError, match="no memory left for one motion"):
            problem._predict([run])
        assert launches == [3, 2, 1]
        return
    problem._predict([run])
    assert launches == ([3, 2, 1] if most == 2 else [3, 2, 1, 1, 1])
    np.testing.assert_array_equal(run.out, expected)


@pytest.mark.parametrize(("point", "tried"), [({"young": 1e5}, [1, 2]), ({"young": 1e5, "strain_stiffening.k": 4.0}, [1, 2, 6])])
def test_a_motion_that_fails_alone_takes_finer_steps_too(experiment, monkeypatch, point, tried):
    """Alone a body has fewer inner steps than in a launch beside a stiffer one."""
    problem, setting = body_problem(experiment), settings.SOLVERS[1]
    asked, rollout = [], FiniteElements.rollout

    def watched(self, *args, inner_factor, nan_on_failure=False, **options):
        asked.append(inner_factor)
        if inner_factor < tried[-1]:
            raise UserError("the motion is not finite")
        return rollout(self, *args, inner_factor=inner_factor, nan_on_failure=nan_on_failure, **options)

    monkeypatch.setattr(FiniteElements, "rollout", watched)
    assert torch.isfinite(problem._moved(point, 0, setting).x).all() and asked == tried
    monkeypatch.setattr(rollouts, "FINER", (1, 1, 1))
    with pytest.raises(UserError, match="not finite"):
        problem._moved(point, 0, setting)


def test_finite_elements_take_finer_steps_where_an_effect_stiffens(tmp_path, monkeypatch):
    """Inner steps are stable at rest; a body that stiffens as it is pressed leaves the finite otherwise."""
    measured = made.experiment(tmp_path / "measured", {}, frames=16)
    point, finite_elements = {"young": 1e5, "strain_stiffening.k": 40.0}, settings.SOLVERS[1]

    def predicted(finer):
        monkeypatch.setattr(rollouts, "FINER", finer)
        return body_problem(measured).predict([{"young": 1e5}, point], 0, finite_elements)

    once, fine, finest = predicted((1,)), predicted((1, 2)), predicted((8,))
    assert np.isfinite(once[0]).all() and np.isnan(once[1]).all()
    assert np.array_equal(fine[0], once[0]) and np.abs(finest[0] - once[0]).max() < 1e-3
    moved = np.abs(fine[1] - fine[0]).max()
    assert np.isfinite(fine[1]).all() and np.abs(fine[1] - finest[1]).max() < 0.15 * moved
