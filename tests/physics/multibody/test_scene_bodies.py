"""Bodies that bring their laws, densities, fields and initial motion."""

import pytest
import torch

from neuido.data.bodies import shapes
from neuido.errors import UserError
from neuido.physics.effects.parameters import Effects
from neuido.physics.laws.base import AutogradElastic
from neuido.physics.laws.classical import DruckerPrager, FixedCorotated, Identity, Sigma, VonMises
from neuido.physics.mpm.simulator import Simulator
from neuido.types import Body, Scene

CUBE = {"length": 0.15, "particles_per_side": 4}


def simulator(*bodies, **options):
    return Simulator(Scene(cells=16, dt=1e-3, bodies=bodies, **options), device="cpu", dtype=torch.float64)


def neo(F, young):
    """A law of one's own: J-free neo-Hookean with one modulus for each particle."""
    return young.reshape(-1, 1, 1) * (F @ F.mT - torch.eye(3, dtype=F.dtype))


def left(**options):
    return Body(shape=shapes.cube(centre=(0.3, 0.1, 0.5), velocity=(0.0, -2.0, 0.0), **CUBE), name="left", **options)


def right(**options):
    return Body(shape=shapes.cube(centre=(0.65, 0.1, 0.5), velocity=(0.0, -1.0, 0.0), **CUBE), name="right", **options)


@pytest.mark.parametrize("contact", ["separate", "sticky"])
@pytest.mark.parametrize("own", [False, True])
def test_apart_each_body_moves_as_in_a_scene_of_its_own(contact, own):
    young = torch.linspace(1e4, 2e4, 64, dtype=torch.float64)
    soft = (
        {"law": AutogradElastic(neo, fields=("young",), modulus=4e4), "fields": {"young": young}}
        if own
        else {"law": FixedCorotated(1e4, 0.2)}
    )
    hard = {"law": Sigma(1e5, 0.3), "plasticity": VonMises(1e3, 1e5, 0.3), "density": 2000.0}
    bodies = left(**soft, density=500.0), right(**hard)
    with torch.no_grad():
        together = simulator(*bodies, contact=contact).rollout(60, every=60)
        alone = [simulator(body).rollout(60, every=60) for body in bodies]
    assert torch.allclose(together.x[-1], torch.cat([frames.x[-1] for frames in alone]), atol=1e-12)
    assert together.body_names == ("left", "right")
    assert together.body.bincount().tolist() == [64, 64]


def test_each_body_has_the_viscosity_of_its_law():
    viscous = FixedCorotated(1e4, 0.2)
    eta = torch.tensor([3.0], dtype=torch.float64, requires_grad=True)
    viscous.viscosity = eta
    spin = {"spin": (0.0, 0.0, 9.0)}
    bodies = left(law=viscous, **spin), right(law=FixedCorotated(1e4, 0.2), **spin)
    effects = Effects(viscosity_shear=1.0)
    together = simulator(*bodies).rollout(60, every=60, effects=effects)
    plain = left(law=FixedCorotated(1e4, 0.2), **spin)
    with torch.no_grad():
        alone = [simulator(plain).rollout(60, every=60, effects=Effects(viscosity_shear=4.0))]
        alone += [simulator(bodies[1]).rollout(60, every=60, effects=effects)]
        less = simulator(plain).rollout(60, every=60, effects=effects)
    assert torch.allclose(together.x[-1].detach(), torch.cat([frames.x[-1] for frames in alone]), atol=1e-12)
    assert (less.x[-1] - alone[0].x[-1]).abs().max() > 1e-6
    together.x[-1].square().sum().backward()
    assert eta.grad.abs().item() > 0
    viscous.viscosity = torch.tensor([1e4])
    with pytest.raises(UserError, match="viscosity of 1e\\+04"):
        simulator(*bodies).rollout(1)


def test_a_single_body_with_a_law_moves_as_one_beside_its_scene():
    law, body = (Sigma(1e5, 0.3), VonMises(1e3, 1e5, 0.3)), shapes.cube(centre=(0.3, 0.1, 0.5), velocity=(0.0, -2.0, 0.0), **CUBE)
    with torch.no_grad():
        brought = simulator(Body(shape=body, law=law[0], plasticity=law[1])).rollout(40, every=40)
        beside = Simulator(Scene(cells=16, dt=1e-3), body, device="cpu", dtype=torch.float64).rollout(40, *law, every=40)
    assert torch.equal(brought.x, beside.x)
    assert beside.body is None


def test_a_field_chooses_between_laws():
    """Half a body of sand and half of rubber is two bodies that stick."""
    x = shapes.cube(centre=(0.3, 0.1, 0.5), velocity=(0.0, -2.0, 0.0), **CUBE)
    upper = x.x[:, 1] > 0.1
    elastic, plastic = [Sigma(1e5, 0.3), FixedCorotated(3e4, 0.2)], [DruckerPrager(30.0, 1e5, 0.3), Identity()]
    whole = Body(shape=x, law=elastic, plasticity=plastic, fields={"law": upper.long()})
    parts = [Body(x.x[own], x.v[own], x.volume[own], law=elastic[i], plasticity=plastic[i]) for i, own in enumerate((~upper, upper))]
    with torch.no_grad():
        one = simulator(whole).rollout(40, every=40).x[-1]
        two = simulator(*parts, contact="sticky").rollout(40, every=40).x[-1]
    assert torch.allclose(torch.cat([one[~upper], one[upper]]), two, atol=1e-12)


def test_gradients_reach_each_law_and_field():
    sim_options = {"contact": "separate"}
    values = [torch.tensor([1e4], dtype=torch.float64), torch.linspace(3e4, 6e4, 64, dtype=torch.float64)]
    values = [value.requires_grad_() for value in values]

    def height(young, field):
        law = AutogradElastic(neo, fields=("young",), modulus=2e5)
        bodies = left(law=FixedCorotated(young, 0.2)), right(law=law, fields={"young": field})
        return simulator(*bodies, **sim_options).rollout(40, every=40).x[-1, :, 1].square().sum()

    gradients = torch.autograd.grad(height(*values), values)
    with torch.no_grad():
        for i, gradient in enumerate(gradients):
            moved = [[y + (sign * 1.0 if j == i else 0.0) for j, y in enumerate(values)] for sign in (1, -1)]
            assert float(gradient.sum()) == pytest.approx(float(height(*moved[0]) - height(*moved[1])) / 2, rel=1e-4)


def test_density_field_and_spin():
    x = shapes.cube(centre=(0.3, 0.5, 0.5), **CUBE)
    density = torch.linspace(500.0, 1500.0, 64)
    sim = simulator(Body(shape=x, density=density, law=FixedCorotated(1e4, 0.2), velocity=(1.0, 0.0, 0.0), spin=(0.0, 0.0, 3.0)))
    assert torch.allclose(sim.mass, density.double() * sim.volume)
    assert torch.allclose(
        sim.state.C[0], torch.tensor([[0.0, -3.0, 0.0], [3.0, 0.0, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64), atol=1e-5
    )
    assert torch.allclose(sim.state.v.mean(0), torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64), atol=1e-6)


def test_step_limit_is_that_of_the_body_with_the_fastest_wave():
    """A stiff heavy body and a soft light one: not the stiff modulus over the light density."""
    sim = simulator(left(law=FixedCorotated(1e6, 0.2), density=5000.0), right(law=FixedCorotated(1e4, 0.2), density=50.0))
    alone = [simulator(body).step_margin(1) for body in sim.bodies[0].bodies]
    assert sim.step_margin(1) == pytest.approx(min(alone))


LAW = FixedCorotated(1e4, 0.2)


@pytest.mark.parametrize(
    ("bodies", "match"),
    [
        ((left(law=LAW), right()), "body 'right' has no law; give `law` to each body, or a law to `rollout`"),
        ((left(law=[LAW, LAW]),), "body 'left' has no field 'law', which its law takes; its fields: none"),
        ((left(law=[LAW, LAW], fields={"law": torch.full((64,), 2)}),), "field law has indices 2 to 2 for 2 laws"),
        ((left(law=FixedCorotated(torch.full((3,), 1e4), 0.2)),), "has 3 rows of parameters; give one, or one for each of 64"),
        ((left(law=AutogradElastic(neo, fields=("young",), modulus=1e4), fields={"young": torch.ones(3)}),), "its first axis must have 64"),
        ((left(law=Identity()),), "Identity is no elastic law"),
    ],
)
def test_laws_that_do_not_fit_are_refused(bodies, match):
    with pytest.raises(UserError, match=match):
        simulator(*bodies).rollout(1)


@pytest.mark.parametrize(
    ("bodies", "match"),
    [
        ((), "scene 0 has no body"),
        ((left(), left()), "are named left, left; give each a name of its own"),
        ((left(density=-1.0),), "density of body 'left' of scene 0 is -1.0"),
        ((left(density=torch.ones(3)),), "give one positive number, or one for each of 64 particles"),
    ],
)
def test_bodies_that_do_not_fit_are_refused(bodies, match):
    with pytest.raises(UserError, match=match):
        simulator(*bodies)
    with pytest.raises(UserError, match="a scene brings bodies, and further ones are given beside it"):
        Simulator(Scene(bodies=[left()]), left(), device="cpu")
    with pytest.raises(TypeError, match="body 'ghost' has no particles"):
        Body(name="ghost")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda body: Scene(bodies=[{"shape": "ball"}]), r"bodies\[0\] of scene 0 is a dict; give a neuido.Body"),
        (lambda body: Scene(bodies=body), "bodies of scene 0 is a Body; give a list"),
        (lambda body: Scene(bodies=[shapes.ball(centre=0.5, radius=0.1, spacing=0.04)]), "centre must be three finite numbers, got 0.5"),
        (lambda body: Scene(bodies=[body], colliders=3), "colliders of scene 0 is a int; give a list"),
        (lambda body: Scene(bodies=[body], gravity=-9.8), "gravity of scene 0 is -9.8; give three numbers"),
        (lambda body: Scene(bodies=[Body(shape=body, velocity=(1.0, 2.0))]), "velocity of a body .* give three numbers"),
        (lambda body: Scene(bodies=[Body(shape=body, spin=3.0)]), "spin of a body is 3.0; give three numbers"),
        (lambda body: Scene(bodies=[Body(shape="ball")]), "shape of a body is 'ball'; give one of neuido.shapes"),
    ],
)  # fmt: skip
def test_values_of_a_wrong_kind_are_one_line(make, message):
    with pytest.raises((UserError, TypeError), match=message):
        Simulator(make(shapes.cube(length=0.2, centre=(0.5, 0.5, 0.5), particles_per_side=4)), device="cpu")
