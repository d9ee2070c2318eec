"""Particles that leave the domain: an error, clamped, or deleted."""

import pytest
import torch

from neuido.data.bodies.shapes import cube
from neuido.errors import UserError
from neuido.physics.laws import FixedCorotated
from neuido.physics.mpm import Simulator
from neuido.types import Scene

LAW = FixedCorotated(2e4, 0.3)
BODY = cube(length=0.2, particles_per_side=4, velocity=(3.0, 0.0, 0.5), centre=(0.7, 0.5, 0.5))
OPEN = Scene(cells=10, dt=2e-3, walls=None)
STEPS = 100


def simulator(on_leave, dtype=torch.float32, **options):
    return Simulator(OPEN, BODY, device="cpu", dtype=dtype, on_leave=on_leave, **options)


def test_an_error_is_the_default_and_names_the_choice():
    with pytest.raises(UserError, match=r"left the domain.*on_leave"):
        Simulator(OPEN, BODY, device="cpu").rollout(STEPS, LAW)
    with pytest.raises(UserError, match="choose error, clamp or delete"):
        simulator("ignore")


def test_deleted_particles_stay_where_they_left_and_are_counted():
    frames = simulator("delete").rollout(STEPS, LAW, every=10)
    out = ((frames.x < 0) | (frames.x > 1)).any(-1)
    assert 0 < out[5].sum() < 64 and out[-1].all()  # some frames have a part of them
    for k in range(2, len(out)):
        gone = out[k - 1]
        assert (frames.x[k, gone] == frames.x[k - 1, gone]).all() and (frames.v[k, gone] == 0).all()
    (event,) = frames.events
    first = int(out.any(1).nonzero()[0])
    assert (event.kind, event.count, event.total, event.frame, event.step) == ("left", 64, 64, first, 10 * first)
    assert "64 of 64 particles left the domain and were deleted" in str(event)


def test_a_deleted_particle_contributes_nothing():
    """Free flight of what is left: the momentum of the particles inside stays theirs, and the stress of those outside does not act."""
    sim = simulator("delete", torch.float64)
    frames = sim.rollout(STEPS, FixedCorotated(1e-3, 0.3), gravity=torch.zeros(1, 3))
    inside = ~((frames.x < 0) | (frames.x > 1)).any(-1)
    assert inside[60].any() and not inside[60].all()
    start = sim.state.v
    assert (frames.v[60][inside[60]] - start[inside[60]]).abs().max() < 1e-3


def test_clamped_particles_stay_inside_and_are_counted():
    frames = simulator("clamp").rollout(3 * STEPS, LAW, every=10)
    assert frames.x.min() >= 0 and frames.x.max() <= 1
    assert frames.v[-1].abs().max() < 2.0  # it came with 3 m/s: a face takes the momentum that points outwards
    (event,) = frames.events
    assert event.kind == "clamped" and 0 < event.count <= 64 and "clamped" in str(event)


def test_a_domain_that_nothing_leaves_has_the_same_bits():
    slow = BODY._replace(v=0.1 * BODY.v)
    runs = [Simulator(OPEN, slow, device="cpu", on_leave=mode).rollout(20, LAW) for mode in ("error", "clamp", "delete")]
    for part in range(4):
        assert torch.equal(runs[0][part], runs[1][part]) and torch.equal(runs[0][part], runs[2][part])
    assert runs[1].events == runs[2].events == ()


@pytest.mark.parametrize("on_leave", ["clamp", "delete"])
def test_segments_and_states_carry_it_on(on_leave):
    sim = simulator(on_leave)
    whole = sim.rollout(STEPS, LAW, every=10)
    half = sim.rollout(STEPS // 2, LAW, every=10)
    rest = sim.rollout(STEPS // 2, LAW, every=10, state=type(sim.state)(*(part[-1] for part in half[:4])))
    torch.testing.assert_close(rest.x[-1], whole.x[-1], rtol=0, atol=1e-6)
    v = sim.state.v.clone().requires_grad_()
    grads = []
    for segment in (None, 20):
        frames = sim.rollout(STEPS, LAW, every=10, segment=segment, state=sim.state._replace(v=v))
        torch.testing.assert_close(frames.x[-1], whole.x[-1], rtol=0, atol=1e-6)
        grads.append(torch.autograd.grad(frames.x[-1].square().sum(), v)[0])
    torch.testing.assert_close(grads[0], grads[1], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("store", ["state", "all"])
@pytest.mark.parametrize("on_leave", ["clamp", "delete"])
def test_gradients_agree_with_finite_differences(on_leave, store):
    sim = simulator(on_leave, torch.float64, store=store)
    strained = sim.state.F @ torch.diag(torch.tensor([1.1, 0.95, 1.0], dtype=torch.float64))
    generator = torch.Generator().manual_seed(2)
    direction = torch.randn(64, 3, generator=generator, dtype=torch.float64)
    weight = torch.randn(64, 3, generator=generator, dtype=torch.float64)
    steps = 48  # a part of the body is outside, at different substeps

    def loss(v, mass, young):
        frames = sim.rollout(steps, FixedCorotated(young, 0.3), state=sim.state._replace(v=v, F=strained), mass=mass, every=12)
        return (weight * frames.x[-1]).sum() + (weight * frames.v[2]).sum()

    inputs = [sim.state.v.clone(), sim.mass.clone(), torch.tensor(2e4, dtype=torch.float64)]
    for t in inputs:
        t.requires_grad_()
    value = loss(*inputs)
    out = ((sim.rollout(steps, LAW).x[-1] - 0.5).abs() > 0.5 - 1e-9).any(-1)
    assert 0 < out.sum() < 64
    gradients = torch.autograd.grad(value, inputs)
    for i, (gradient, towards) in enumerate(zip(gradients, (direction, sim.mass * direction[:, 0], torch.tensor(1e4)))):
        step = 1e-7
        moved = [[t.detach() + sign * step * towards if j == i else t.detach() for j, t in enumerate(inputs)] for sign in (1, -1)]
        slope = (loss(*moved[0]) - loss(*moved[1])) / (2 * step)
        assert float((gradient * towards).sum()) == pytest.approx(float(slope), rel=1e-4), i


def test_scenes_in_threads_do_it_each_for_itself():
    still = BODY._replace(v=0 * BODY.v, x=BODY.x - torch.tensor([0.2, 0.0, 0.0]))
    frames = Simulator([OPEN, OPEN], [BODY, still], device="cpu", on_leave="delete").rollout(60, LAW, gravity=torch.zeros(2, 3), every=60)
    (event,) = frames.events
    assert event.scene == 0 and event.count > 0
