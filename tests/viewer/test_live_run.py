"""A live simulation: it runs as `rollout` does, follows what is changed and pulled, and says what is wrong."""

import numpy as np
import pytest
import torch

from neuido import Operator, Scene, Simulator, UserError, laws, shapes
from neuido.physics.colliders import Sphere
from neuido.types import Keyframes
from neuido.viewer.live.live_run import LawFamily, LiveRun, classical_family, latent_family

MATERIAL = {"law": "fixed_corotated", "young": 3e4, "poisson": 0.3}


def live(gravity=(0.0, -9.8, 0.0)) -> LiveRun:
    body = shapes.ball(centre=(0.5, 0.5, 0.5), radius=0.12, spacing=0.04)
    simulator = Simulator(Scene(cells=16, dt=1e-3, gravity=gravity), body, device="cpu")
    return LiveRun(simulator, classical_family(MATERIAL, {"law": "identity"}))


def test_chunks_are_a_rollout():
    run = live()
    for count in (3, 5, 2):
        run._chunk(count)
    whole = run.simulator.rollout(10, laws.FixedCorotated(3e4, 0.3), every=10)
    assert run.time == pytest.approx(0.01) and run.steps_done == 10
    assert torch.allclose(run.state.x, whole.x[-1], atol=1e-6) and torch.allclose(run.state.v, whole.v[-1], atol=1e-4)


def test_gravity_and_parameters_are_followed():
    run = live()
    run.gravity = (4.0, 0.0, 0.0)
    run._chunk(10)
    assert torch.allclose(run.state.v.mean(dim=0), torch.tensor([0.04, 0.0, 0.0]), atol=1e-4)
    before = float(run.laws[0].modulus())
    run.change("young", 6e4)
    run._turn()
    assert float(run.laws[0].modulus()) == pytest.approx(2 * before)


def test_a_pull_moves_the_body_towards_its_target_with_the_force_it_tells():
    run = live(gravity=(0.0, 0.0, 0.0))
    start = run.state.x.mean(dim=0).numpy()
    run.grip(start + np.array([0.12, 0.0, 0.0]))
    run.drag(start + np.array([0.32, 0.0, 0.0]))
    mass, dt = float(run.simulator.mass.sum()), run.scene.dt
    run._chunk(5)
    momentum = mass * float((run.simulator.mass[:, None] * run.state.v).sum(dim=0)[0] / mass)
    assert momentum == pytest.approx(run.force[0] * 5 * dt, rel=1e-3)
    for _ in range(20):
        run._chunk(run._count())
    assert run.state.x.mean(dim=0)[0] > start[0] + 0.005
    held = run.held()
    assert held is not None and np.allclose(held[1], start + np.array([0.32, 0.0, 0.0]))
    run.release()
    assert run.held() is None and not run.force.any()


def test_reset_returns_to_the_start():
    run = live()
    run._chunk(4)
    run.reset()
    run._turn()
    assert run.time == 0.0 and torch.equal(run.state.x, run.simulator.state.x)


def test_what_fails_is_one_line_and_the_thread_lives_on():
    run, seen = live(), []
    run.shown = lambda: seen.append(run.error)
    run.start()
    try:
        run.change("young", 1e9)
        run.play()
        wait(lambda: run.error)
        assert "above the limit" in run.error and "\n" not in run.error and not run.playing
        run.change("young", 3e4)
        run.reset()
        run.step()
        wait(lambda: run.steps_done > 0)
        assert not run.error and any(seen)
    finally:
        run.stop()


def wait(what, seconds=60.0):
    import time

    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end, "the thread did not answer"
        time.sleep(0.01)


def test_several_scenes_are_refused():
    body = shapes.ball(centre=(0.5, 0.5, 0.5), radius=0.12, spacing=0.04)
    simulator = Simulator([Scene(cells=16)] * 2, [body] * 2, device="cpu")
    with pytest.raises(UserError, match="2 scenes"):
        LiveRun(simulator, LawFamily(lambda values: (None, None), ()))


def test_colliders_keep_their_motion_over_chunks_and_follow_a_slider():
    body = shapes.ball(centre=(0.5, 0.7, 0.5), radius=0.1, spacing=0.04)
    path = Keyframes((0.0, 0.02), ((0.2, 0.2, 0.5), (0.24, 0.2, 0.5)))
    solids = (
        Sphere(radius=0.1, path=path),
        Sphere(radius=0.1, position=(0.8, 0.2, 0.5)),
        Sphere(radius=0.1, position=(0.5, 0.4, 0.5), mass=1.0),
    )
    simulator = Simulator(Scene(cells=16, dt=1e-3, colliders=solids), body, device="cpu")
    run = LiveRun(simulator, classical_family(MATERIAL, {"law": "identity"}))
    assert run.colliders.movable() == [1]
    run.move_collider(1, np.array([0.8, 0.3, 0.5]))
    for count in (4, 3, 5):
        run._chunk(count)
    whole = simulator.rollout(12, laws.FixedCorotated(3e4, 0.3), every=12).colliders
    assert run.colliders.poses[0, :3] == pytest.approx([0.224, 0.2, 0.5], abs=1e-6)
    assert run.colliders.poses[2, :3] == pytest.approx(whole[2].poses[-1][:3, 3].numpy(), abs=1e-6)
    assert run.colliders.poses[1, 1] > 0.25
    run.reset()
    run._turn()
    assert run.colliders.poses[0, 0] == pytest.approx(0.2)


def test_a_share_leads_from_the_law_of_one_latent_to_that_of_another():
    operator = Operator.from_pretrained("pretrained")
    a, b = (operator.latent(name) for name in operator.latent_names[:2])
    family = latent_family(operator, a, b)
    with torch.no_grad():
        for share, z in ((0.0, a), (0.5, (a + b) / 2), (1.0, b)):
            made, expected = family.make({"share": share})[0], operator.laws(z)[0]
            assert all(torch.allclose(one, other, rtol=1e-4) for one, other in zip(made.tensors(), expected.tensors()))
