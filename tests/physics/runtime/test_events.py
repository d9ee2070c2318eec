"""Events of a rollout: matter that turned inside out or collapsed is told of by every solver, at the step at which it happened."""

import math
from dataclasses import replace

import pytest
import torch

from neuido.data.bodies.shapes import cube
from neuido.errors import UserError
from neuido.physics.effects import Effects
from neuido.physics.fem import FiniteElements
from neuido.physics.laws import AutogradElastic, FixedCorotated, NeoHookean, VonMises
from neuido.physics.laws.neural.symbolic import SymbolicElastic
from neuido.physics.mpm import Simulator
from neuido.physics.runtime.events import COLLAPSED, determinant, marks_of_frames
from neuido.physics.runtime.frames import Frames
from neuido.types import Particles, Scene

LAW = FixedCorotated(1e4, 0.3)
BODY = cube(length=0.25, particles_per_side=4, velocity=(0.0, -4.0, 0.0), centre=(0.5, 0.3, 0.5))
SLOW = BODY._replace(v=0.05 * BODY.v)
SCENE = Scene(cells=12, dt=2e-3)


def first_below(F):
    """The frames in which det F is below the limit, counted by torch."""
    J = torch.linalg.det(F.double())
    low = J < COLLAPSED
    return [(k, p) for k, p in low.nonzero().tolist()], J


def test_a_collapse_is_noted_at_its_first_substep_though_no_frame_shows_it():
    sim = Simulator(SCENE, BODY, device="cpu")
    every = sim.rollout(150, LAW, every=1)
    below, J = first_below(every.F)
    (event,) = sim.rollout(150, LAW, every=150).events
    assert (event.kind, event.step) == ("collapsed", below[0][0])
    assert event.time == pytest.approx(event.step * SCENE.dt) and event.frame == 1
    assert event.count == len({p for _, p in below}) and event.total == 64
    assert event.extreme == pytest.approx(float(J.min()), rel=1e-3)
    assert "64 of 64 particles collapsed" in str(event)


def test_scenes_segments_and_threads_tell_the_same_events():
    sim = Simulator([SCENE, SCENE], [SLOW, BODY], device="cpu", threads=False)
    (one,) = sim.rollout(150, LAW, every=50).events
    assert one.scene == 1 and one.first >= 64
    (threaded,) = Simulator([SCENE, SCENE], [SLOW, BODY], device="cpu").rollout(150, LAW, every=50).events
    x = sim.state.x.clone().requires_grad_()
    (segmented,) = sim.rollout(150, LAW, every=10, segment=50, state=sim.state._replace(x=x)).events
    assert threaded == one and segmented._replace(frame=one.frame) == one


def test_a_substep_of_a_later_segment_is_counted_from_the_start():
    """A failure in the second segment names the substep of the whole rollout."""
    body = BODY._replace(v=torch.tensor([0.0, 4.0, 0.0]).expand_as(BODY.v).contiguous())
    sim = Simulator(replace(SCENE, gravity=(0.0, 0.0, 0.0), walls=None), body, device="cpu")
    x = sim.state.x.clone().requires_grad_()
    messages = []
    for segment in (None, 60):
        with pytest.raises(UserError) as raised:
            sim.rollout(120, LAW, every=60, segment=segment, state=sim.state._replace(x=x))
        messages.append(str(raised.value))
    assert messages[0] == messages[1] and "of 120)" in messages[0]


def test_nothing_happens_to_a_body_that_bounces():
    for solver in (Simulator, FiniteElements):
        assert solver(SCENE, SLOW, device="cpu").rollout(60, NeoHookean(1e4, 0.3), every=20).events == ()


def test_elements_that_turn_inside_out_are_noted():
    solver = FiniteElements([SCENE, SCENE], [SLOW, BODY], device="cpu")
    found = solver.rollout(40, LAW, every=20).events
    assert found and {event.scene for event in found} == {1} and found[0].extreme < COLLAPSED
    assert found[0].what == "elements" and 0 < found[0].time <= 40 * SCENE.dt
    shown = marks_of_frames(solver.rollout(40, LAW, every=1).F, solver.particles.scene, (SCENE.dt,) * 2).events()
    assert found[0].time <= shown[0].time + SCENE.dt


@pytest.mark.parametrize(("solver", "steps"), [(Simulator, 150), (FiniteElements, 60)])
def test_an_inversion_is_an_error_where_that_is_asked_for(solver, steps):
    sim = solver([SCENE, SCENE], [BODY, SLOW], device="cpu", on_inversion="error")
    with pytest.raises(UserError, match=r"scene 0: .*det F.*on_inversion = report goes on"):
        sim.rollout(steps, LAW, every=steps)
    frames = sim.rollout(steps, LAW, every=steps, nan_on_failure=True)
    assert torch.isfinite(frames.x).all(2).all(0).view(2, -1).tolist() == [[False] * 64, [True] * 64]
    with pytest.raises(UserError, match="choose report or error"):
        solver(SCENE, BODY, device="cpu", on_inversion="ignore")


def test_frames_alone_tell_of_inversions_too():
    F = torch.eye(3).repeat(3, 4, 1, 1)
    F[1, 2] = torch.diag(torch.tensor([-1.0, 1.0, 1.0]))
    F[2, 3, 0, 0] = 1e-4
    x = torch.zeros(3, 4, 3)
    frames = Frames(x, x, F, F, [0.5, 0.25], Particles(torch.tensor([0, 0, 1, 1]), (0, 2, 4)))
    assert [(e.kind, e.scene, e.first, e.time, e.frame) for e in frames.events] == [
        ("inverted", 1, 2, 0.25, 1),
        ("collapsed", 1, 3, 0.5, 2),
    ]
    assert Frames(x, x, F[:1].expand(3, -1, -1, -1), F[:1].expand(3, -1, -1, -1)).events == ()
    assert torch.allclose(determinant(F), torch.linalg.det(F))


@pytest.mark.parametrize("stretch", [0.2, 3.0])
def test_a_law_that_is_asked_beyond_its_training_is_told(stretch):
    """At F = 0.2 I the series of the objective networks has the wrong sign: the law pulls where it should push."""
    law = SymbolicElastic(torch.tensor([[[1.0] + [0.0] * 6, [1.0] + [0.0] * 6, [0.0] * 7, [0.0] * 7]]))
    sim = Simulator(replace(SCENE, gravity=(0.0, 0.0, 0.0)), SLOW, device="cpu")
    F = stretch * torch.eye(3).expand(64, 3, 3)
    (event,) = sim.rollout(1, law, state=sim.state._replace(F=F.contiguous(), v=0 * sim.state.v), check=False).events
    assert event.kind == "outside training" and event.count == 64 and event.step == 0
    assert event.extreme == pytest.approx(abs(math.log(stretch)), rel=0.05)
    assert sim.rollout(1, law).events == ()
    free = AutogradElastic(lambda F: 0 * F, modulus=1e4)
    assert sim.rollout(1, free, state=sim.state._replace(F=F.contiguous())).events == ()


def test_what_collapses_is_the_fixed_corotated_law_and_not_its_hardening():
    """Hardening lies between perfect plasticity and the elastic body; that of the fixed-corotated law is crushed, others are not."""
    effects = Effects.of({"kinematic_hardening.h": 1e6})
    sim = Simulator(SCENE, BODY, device="cpu")
    for law, collapses in ((FixedCorotated, True), (NeoHookean, False)):
        for plasticity, added in ((None, None), (VonMises(300.0, 1e4, 0.3), effects)):
            events = sim.rollout(150, law(1e4, 0.3), plasticity, effects=added, every=150).events
            assert [event.kind for event in events] == ["collapsed"] * collapses
    energy = 0.5 * float(FixedCorotated(1e4, 0.3).modulus())  # of a body crushed to nothing along one axis, a volume
    assert energy < 0.5 * 1000.0 * 4.0**2
