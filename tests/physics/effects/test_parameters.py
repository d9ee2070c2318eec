"""Effects in a rollout: against the slow twin, finite differences and closed forms; and the library of effects."""

import math
import re

import pytest
import torch

from neuido.errors import UserError
from neuido.physics.effects.parameters import LIBRARY, Effects, ball_inclusion, linear_gradient
from neuido.physics.laws.classical import DruckerPrager, FixedCorotated, NeoHookean, Sigma, VonMises, stack
from neuido.physics.mpm import reference
from neuido.physics.mpm.simulator import Simulator
from neuido.physics.points.point_mass import Forces
from neuido.types import ParticleState, Plane, Scene
from tests.physics.bodies import DEVICE, block, busy_scenes, same

FORCES = {"gravity.g": 0.3, "magnus.x": 1.0, "magnus.y": [2.0, 1.0], "magnus.z": 0.7, "stick.rate": 3.0, "restitution.rate": [4.0, 9.0],
          "added_mass.c": 0.1, "friction.mu": 0.1, "spin_decay.k": [2.0, 5.0],
          "time_force.x0": 0.3, "time_force.y2": [1.0, 2.0]}  # fmt: skip
ELASTIC = {"maxwell.ratio": 0.5, "maxwell.time": [0.1, 0.2], "hysteresis.eta": [0.1, 0.05], "strain_stiffening.k": 1.0,
           "second_invariant.c": 0.3, "tension_compression.r": 0.4, "fibre.c": [1e4, 2e4], "fibre.azimuth": 0.3, "fibre.elevation": 0.2,
           "stiffness_change.rate": [1.0, 2.0], "swelling.rate": [2.0, -3.0],
           "stiffness_gradient.x": 0.3, "stiffness_gradient.log_ratio": 0.4,
           "stiffness_gradient.radius": 0.1, "stiffness_gradient.cy": 0.02, "stiffness_gradient.width": 0.05}  # fmt: skip
PLASTIC = {"hardening.h": 1e3, "softening.s": 2.0, "kinematic_hardening.h": 1e3, "rate_yield.eta": 1.0}
KEPT = {"maxwell.time": 0.1, "stiffness_gradient.radius": 0.1, "stiffness_gradient.width": 0.05, "fibre.azimuth": 0.3}
"""What has a value where the effect is absent too."""
CASES = {
    "forces": (FORCES, "elastic"),
    "yield": ({**ELASTIC, **PLASTIC, "yield.inverse": [1e-3, 5e-4], "viscosity_shear.eta": 2.0}, "elastic"),
    "damage": ({**ELASTIC, "softening.s": 0.5}, "elastic"),
    "von_mises": ({**ELASTIC, **PLASTIC, **FORCES}, "von_mises"),
    "cone": ({**ELASTIC, "cohesion.c": [500.0, 300.0]}, "drucker_prager"),
    "mixed": ({"maxwell.ratio": 0.5, "maxwell.time": 0.1, "stiffness_change.rate": 3.0}, "mixed"),
    "zero": ({key: 0.0 for key in (*FORCES, *ELASTIC) if key not in KEPT} | KEPT, "elastic"),
    "zero_flow": (dict.fromkeys(PLASTIC, 0.0), "von_mises"),
    "memory": ({"maxwell.ratio": 0.5, "maxwell.time": 0.1}, "mixed"),
}
"""Values of the parameters, and the base plasticity."""
INTERVAL = 0.005


class Case:
    """Two busy scenes with contact, every parameter of a case and every input a leaf."""

    def __init__(self, name: str, threads: bool = False):
        values, self.plastic = CASES[name]
        self.sim = Simulator(*busy_scenes(), dtype=torch.float64, device=DEVICE, threads=threads)
        g = torch.Generator().manual_seed(3)
        F = self.sim.state.F + 0.05 * torch.randn(self.sim.state.F.shape, generator=g, dtype=torch.float64).to(DEVICE)
        if name.startswith("zero"):  # where every diagnosis begins: no effect, a body at rest in itself
            F = self.sim.state.F
        self.leaves = {key: self.leaf(value) for key, value in values.items()}
        self.inputs = {
            "x": self.leaf(self.sim.state.x),
            "v": self.leaf(self.sim.state.v),
            "C": self.leaf(self.sim.state.C),
            "F": self.leaf(F),
            "mass": self.leaf(self.sim.mass),
            "gravity": self.leaf(self.sim.gravity),
            "friction": self.leaf(self.sim.colliders.friction),
            "young": self.leaf(5e4),
            "poisson": self.leaf(0.3),
            "limit": self.leaf(2e3),
            "angle": self.leaf(25.0),
        }

    @staticmethod
    def leaf(value):
        return torch.as_tensor(value, dtype=torch.float64).clone().to(DEVICE).requires_grad_()

    def laws(self):
        i = self.inputs
        pairs = [(i["young"], i["poisson"]), (2 * i["young"], i["poisson"])]
        mises, sand = ([law(i[key], *pair) for pair in pairs] for law, key in ((VonMises, "limit"), (DruckerPrager, "angle")))
        elastic = stack([FixedCorotated(*pairs[0]), Sigma(*pairs[1])])
        kinds = {"elastic": None, "von_mises": mises, "drucker_prager": sand, "mixed": [mises[0], sand[1]]}
        return elastic, None if kinds[self.plastic] is None else stack(kinds[self.plastic])

    def effects(self):
        values = dict(self.leaves)
        if any(key.startswith("time_force") for key in values):
            values["time_force.interval"] = INTERVAL
        return Effects.of(values, x=self.sim.state.x, scene=self.sim.particles.scene)

    def loss(self, run, steps, **options):
        i = self.inputs
        state = ParticleState(*(i[key] for key in "xvCF"))
        frames = run(steps, *self.laws(), state=state, mass=i["mass"], gravity=i["gravity"], friction=i["friction"],
                     effects=self.effects(), every=3, **options)  # fmt: skip
        total = 0.0
        for n, t in enumerate(frames):
            weights = torch.randn(t.shape, generator=torch.Generator().manual_seed(n), dtype=t.dtype)
            total = total + (t * weights.to(t.device)).sum()
        return total, frames

    def gradients(self, run, steps, **options):
        loss, frames = self.loss(run, steps, **options)
        names = [*self.leaves, *self.inputs]
        grads = torch.autograd.grad(loss, [*self.leaves.values(), *self.inputs.values()], allow_unused=True)
        return frames, {name: g for name, g in zip(names, grads) if g is not None}


@pytest.mark.parametrize("name", CASES)
@pytest.mark.slow
def test_rollout_equals_its_slow_twin(name):
    case = Case(name)
    frames, fast = case.gradients(case.sim.rollout, 12)
    expected, slow = case.gradients(lambda *a, **k: reference.rollout(case.sim, *a, **k), 12)
    for key, a, b in zip("xvCF", frames, expected):
        assert torch.allclose(a, b, rtol=0, atol=1e-11 * float(b.detach().abs().max())), key
    assert set(fast) == set(slow) and set(case.leaves) <= set(fast)
    for key in fast:
        assert float((fast[key] - slow[key]).norm()) <= 1e-9 * float(slow[key].norm()), key
        assert float(slow[key].norm()) > 0 or (name == "zero" and key in (*KEPT, "fibre.elevation", "stiffness_gradient.cy")), key


@pytest.mark.parametrize("name", ["forces", "yield", "damage", "von_mises", "cone"])
def test_gradient_of_each_parameter_equals_finite_differences(name):
    case = Case(name)
    _, gradients = case.gradients(case.sim.rollout, 6)
    for key, t in case.leaves.items():
        direction = torch.randn(t.shape, generator=torch.Generator().manual_seed(9), dtype=t.dtype).to(t.device)
        h = 1e-5 * float(t.detach().norm() / direction.norm())
        values = []
        with torch.no_grad():
            for shift in (-2, -1, 1, 2):
                t.add_(shift * h * direction)
                values.append(float(case.loss(case.sim.rollout, 6)[0]))
                t.sub_(shift * h * direction)
        numeric = (8 * (values[2] - values[1]) - (values[3] - values[0])) / (12 * h)
        analytic = float((gradients[key] * direction).sum())
        assert abs(numeric - analytic) <= 1e-5 * abs(analytic) + 1e-9 / abs(h), f"{key}: {numeric} {analytic}"


@pytest.mark.parametrize("name", ["von_mises", "damage", "mixed"])
def test_segments_and_threads_change_nothing(name):
    case, threaded = Case(name), Case(name, threads=True)
    frames, whole = case.gradients(case.sim.rollout, 12)
    for other, options in ((case, {"segment": 6}), (threaded, {})):
        again, pieces = other.gradients(other.sim.rollout, 12, **options)
        assert all(same(a, b) for a, b in zip(frames, again))
        for key in whole:
            assert float((whole[key] - pieces[key]).norm()) <= 1e-9 * float(whole[key].norm()), key


def test_single_precision_follows_double():
    x = {}
    for dtype in (torch.float32, torch.float64):
        sim = Simulator(*busy_scenes(), dtype=dtype, device=DEVICE, threads=False)
        values = {**ELASTIC, **PLASTIC, **FORCES, "yield.inverse": 1e-3, "time_force.interval": INTERVAL}
        effects = Effects.of(values, x=sim.state.x, scene=sim.particles.scene)
        x[dtype] = sim.rollout(50, NeoHookean(5e4, 0.3), effects=effects, every=50).x[-1].double()
    assert float((x[torch.float32] - x[torch.float64]).abs().max()) < 2e-5


# Forces, against closed forms.

SOFT = NeoHookean(2e4, 0.3)


def flight(effects, steps, *, velocity=(0.0, 0.0, 0.0), gravity=(0.0, 0.0, 0.0)):
    """What the centre moves by, and its velocity, without contact."""
    body = block((0.4, 0.4, 0.4), (0.6, 0.6, 0.6), (6, 6, 6), velocity=velocity)
    sim = Simulator(Scene(cells=16, dt=1e-3, gravity=gravity), body, dtype=torch.float64, device=DEVICE)
    frames = sim.rollout(steps, SOFT, effects=effects, every=steps)
    return frames.x[-1].mean(0) - frames.x[0].mean(0), frames.v[-1].mean(0)


def test_gravity_grows_along_itself():
    moved, v = flight(Effects(gravity=0.7), 100, gravity=(3.0, -4.0, 0.0))
    expected = torch.tensor([0.6, -0.8, 0.0], dtype=torch.float64, device=DEVICE) * 5.7
    torch.testing.assert_close(v, 0.1 * expected, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(moved, 0.5 * 0.1 * 0.101 * expected, rtol=1e-9, atol=1e-12)


def test_added_mass_falls_slower_and_keeps_its_weight():
    _, v = flight(Effects(added_mass=0.25, uniform_acceleration=(1.0, 0.0, 0.0)), 100, gravity=(0.0, -10.0, 0.0))
    torch.testing.assert_close(v, torch.tensor([0.1, -0.8, 0.0], dtype=torch.float64, device=DEVICE), rtol=1e-9, atol=1e-12)
    # between springs (a heavier body on the same stiffness) it is the mass that counts
    sim = Simulator(*busy_scenes(), dtype=torch.float64, device=DEVICE, threads=False)
    a = sim.rollout(20, SOFT, effects=Effects(added_mass=0.25), gravity=torch.zeros(2, 3, dtype=torch.float64), every=20)
    b = sim.rollout(20, SOFT, mass=1.25 * sim.mass, gravity=torch.zeros(2, 3, dtype=torch.float64), every=20)
    assert all(same(p, q) for p, q in zip(a, b))


def test_magnus_bends_the_path_to_a_circle():
    w, speed, steps = 8.0, 1.0, 150
    moved, v = flight(Effects(magnus=(0.0, 0.0, w)), steps, velocity=(speed, 0.0, 0.0))
    angle = w * steps * 1e-3
    assert float(v.norm()) == pytest.approx(speed, rel=1e-9)
    expected = [speed / w * math.sin(angle), speed / w * (1 - math.cos(angle)), 0.0]
    torch.testing.assert_close(moved, torch.tensor(expected, dtype=torch.float64, device=DEVICE), rtol=0, atol=2e-3 * speed / w * 2)


def test_time_force_moves_by_its_double_integral():
    knots = torch.tensor([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, 0.0, -2.0]], dtype=torch.float64, device=DEVICE)
    moved, v = flight(Effects(time_force=knots, time_force_interval=0.05), 150)
    # x: a triangle of 4 m/s^2 over 0.1 s, gone from its centre 0.05 s to 0.15 s; z: a rise over 0.05 s, then 0.05 s constant
    torch.testing.assert_close(v, torch.tensor([0.2, 0.0, -0.15], dtype=torch.float64, device=DEVICE), rtol=1e-6, atol=1e-12)
    expected = torch.tensor([0.2 * 0.1, 0.0, -0.05 * (0.05 / 3 + 0.05) - 0.5 * 2.0 * 0.05**2], dtype=torch.float64, device=DEVICE)
    torch.testing.assert_close(moved, expected + 0.5e-3 * v, rtol=1e-4, atol=1e-12)  # positions move with the velocity after a step


# Contact.

HARD = NeoHookean(1e5, 0.3)


def drop(effects, contact="separate", friction=0.0, height=0.15, steps=400, velocity=(0.5, -2.0, 0.0), law=HARD,
         plasticity=None):  # fmt: skip
    floor = Plane((0.0, height, 0.0), (0.0, 1.0, 0.0), contact, friction)
    scene = Scene(cells=16, dt=5e-4, gravity=(0.0, -9.8, 0.0), colliders=(floor,))
    body = block((0.3, height + 0.01, 0.3), (0.55, height + 0.26, 0.55), (6, 6, 6), velocity=velocity)
    sim = Simulator(scene, body, dtype=torch.float64, device=DEVICE)
    return sim.rollout(steps, law, plasticity, effects=effects, every=20)


def test_endless_stick_is_a_sticky_floor():
    a, b, c = drop(Effects(stick=math.inf)), drop(None, "sticky"), drop(None)
    assert all(torch.allclose(p, q, rtol=0, atol=1e-9) for p, q in zip(a, b))
    assert float((a.x[-1] - c.x[-1]).abs().max()) > 0.02


def test_a_lossy_floor_lowers_the_rebound():
    late = [float(drop(Effects(restitution=k), height=0.19).v[10, :, 1].mean()) for k in (0.0, 50.0, 200.0)]
    assert late[0] > 1.05 * late[1] > 1.05**2 * late[2] > 0
    # and leaves the motion along the floor alone
    sides = [float(drop(Effects(restitution=k), "slip").v[-1, :, 0].mean()) for k in (0.0, 200.0)]
    assert sides[0] == pytest.approx(0.5, rel=0.02) and sides[1] == pytest.approx(0.5, rel=0.02)


def test_friction_adds_to_the_collider_s_own():
    assert all(same(p, q) for p, q in zip(drop(Effects(friction=0.25), friction=0.125), drop(None, friction=0.375)))
    assert all(same(p, q) for p, q in zip(drop(Effects(friction=-0.5), friction=0.125), drop(None, friction=0.0)))


# Material.


def test_cohesion_holds_a_column():
    law, sand = Sigma(1e5, 0.3), DruckerPrager(30.0, 1e5, 0.3)
    options = dict(friction=0.6, velocity=(0.0, 0.0, 0.0), law=law, plasticity=sand)
    loose, held = (drop(Effects(cohesion=c), **options).x[-1] for c in (0.0, 2e4))
    plain = drop(None, **options).x[-1]
    assert float((loose - plain).abs().max()) < 1e-9
    extent = [float(x[:, 0].amax() - x[:, 0].amin()) for x in (loose, held)]
    assert extent[0] > 1.2 * extent[1] and extent[1] < 0.24


@pytest.mark.parametrize("plastic", [False, True])
def test_a_uniform_stiffness_is_another_young_s_modulus(plastic):
    def laws(young):
        return {"law": FixedCorotated(young, 0.3), "plasticity": VonMises(3e3, young, 0.3) if plastic else None}

    a = drop(Effects(stiffness=torch.full((216,), 2.0)), **laws(5e4))
    b = drop(None, **laws(1e5))
    assert float((a.x - b.x).abs().max()) < 1e-9
    assert float((a.x - drop(None, **laws(5e4)).x).abs().max()) > 1e-3


@pytest.mark.parametrize("plastic", [False, True])
def test_a_relative_density_is_a_body_of_other_volumes(plastic):
    scene, body = busy_scenes()[0][0], busy_scenes()[1][0]
    laws = FixedCorotated(5e4, 0.3), VonMises(2e3, 5e4, 0.3) if plastic else None
    factor = 0.3 + 2 * torch.rand(len(body.x), generator=torch.Generator().manual_seed(3), dtype=torch.float64).to(body.volume.device)
    other = Simulator(scene, body._replace(volume=body.volume * factor), dtype=torch.float64, device=DEVICE)
    expected = other.rollout(60, *laws, every=60)
    sim = Simulator(scene, body, dtype=torch.float64, device=DEVICE)
    frames = sim.rollout(60, *laws, effects=Effects(relative_density=factor), every=60)
    assert float((frames.x - expected.x).abs().max()) < 1e-10
    assert float((frames.x - sim.rollout(60, *laws, every=60).x).abs().max()) > 1e-4

    def gradient(run):
        leaf = factor.clone().to(DEVICE).requires_grad_()
        x = run(12, *laws, effects=Effects(relative_density=leaf), every=12).x
        weights = torch.randn(x.shape, generator=torch.Generator().manual_seed(0), dtype=x.dtype).to(x.device)
        return torch.autograd.grad((x * weights).sum(), leaf)[0]

    fast, slow = gradient(sim.rollout), gradient(lambda *a, **k: reference.rollout(sim, *a, **k))
    assert float((fast - slow).norm()) <= 1e-9 * float(slow.norm()) and float(slow.norm()) > 0


def test_waves_of_a_relative_density_are_no_faster():
    body = block((0.4, 0.4, 0.4), (0.6, 0.6, 0.6), (4, 4, 4))
    sim = Simulator(Scene(cells=16, dt=1e-2, gravity=(0.0, 0.0, 0.0)), body, dtype=torch.float64, device=DEVICE)
    factor = torch.ones(64)
    factor[7], factor[9] = 9.0, 0.1
    sim.rollout(1, SOFT, effects=Effects(relative_density=factor))
    with pytest.raises(UserError, match="lower `dt`"):
        sim.rollout(1, SOFT, effects=Effects(relative_density=factor, stiffness=factor.clamp(min=1.0)))


def test_yield_leaves_a_dent():
    elastic, plastic = drop(None), drop(Effects(yield_inverse=1 / 3e3))
    heights = [float(frames.x[-1, :, 1].amax() - frames.x[-1, :, 1].amin()) for frames in (elastic, plastic)]
    assert heights[1] < 0.97 * heights[0]


def test_an_effect_of_size_zero_adds_nothing_to_a_body_turned_inside_out():
    """Its stretches have no logarithm; the base law bears it, and so does the law with every effect at zero."""
    body = block((0.3, 0.3, 0.3), (0.6, 0.6, 0.6), (3, 3, 3))
    scene = Scene(cells=16, dt=1e-4, walls=None, gravity=(0.0, 0.0, 0.0))
    sim = Simulator(scene, body, dtype=torch.float64, device=DEVICE)
    F = torch.diag(torch.tensor([-0.4, 1.1, 0.9], dtype=torch.float64)).to(DEVICE)
    state = sim.state._replace(F=F.expand_as(sim.state.F))
    zero = Effects(strain_stiffening=0.0, second_invariant=0.0, tension_compression=0.0, fibre=0.0, fibre_direction=(1.0, 0.0, 0.0),
                   softening=0.0, maxwell_ratio=0.0, maxwell_time=0.01)  # fmt: skip
    plain = sim.rollout(5, FixedCorotated(1e4, 0.3), state=state)
    with_zero = sim.rollout(5, FixedCorotated(1e4, 0.3), state=state, effects=zero)
    assert float((plain.x[-1] - plain.x[0]).abs().max()) > 1e-6
    assert torch.isfinite(with_zero.x).all()
    torch.testing.assert_close(with_zero.x, plain.x, atol=1e-12, rtol=0.0)


def test_parameter_sets_run_in_one_launch():
    scene, body = busy_scenes()[0][0], busy_scenes()[1][0]
    values = {"yield.inverse": [0.0, 1e-3, 0.0], "softening.s": [1.0, 0.0, 0.0], "maxwell.ratio": [0.0, 0.0, 0.5],
              "maxwell.time": [0.0, 0.0, 0.1], "restitution.rate": [0.0, 30.0, 0.0]}  # fmt: skip
    together = Simulator([scene] * 3, [body] * 3, dtype=torch.float64, device=DEVICE)
    tensors = {key: torch.tensor(value, dtype=torch.float64) for key, value in values.items()}
    frames = together.rollout(60, SOFT, effects=Effects.of(tensors), every=60)
    single = Simulator(scene, body, dtype=torch.float64, device=DEVICE)
    alone = [{"softening.s": 1.0}, {"yield.inverse": 1e-3, "restitution.rate": 30.0}, {"maxwell.ratio": 0.5, "maxwell.time": 0.1}]
    count = len(single.mass)
    for s, own in enumerate(alone):
        expected = single.rollout(60, SOFT, effects=Effects.of(own), every=60)
        assert torch.allclose(frames.x[:, s * count : (s + 1) * count], expected.x, rtol=0, atol=1e-9), s


def test_the_step_knows_what_stiffens():
    body = block((0.4, 0.4, 0.4), (0.6, 0.6, 0.6), (4, 4, 4))
    sim = Simulator(Scene(cells=16, dt=1e-2, gravity=(0.0, 0.0, 0.0)), body, dtype=torch.float64, device=DEVICE)
    sim.rollout(1, SOFT)
    many = torch.ones(64)
    many[7] = 9.0
    for effects in (Effects(stiffness=many), Effects(maxwell_ratio=3.0, maxwell_time=1.0), Effects(hysteresis=0.5),
                    Effects(fibre=1e5, fibre_direction=(1.0, 0.0, 0.0)), Effects(second_invariant=3.0)):  # fmt: skip
        with pytest.raises(UserError, match="lower `dt`"):
            sim.rollout(1, SOFT, effects=effects)
    with pytest.raises(UserError, match="lower `dt`"):
        sim.rollout(100, SOFT, effects=Effects(stiffness_change=6.0))


# The library.


def test_gradient_and_inclusion():
    x = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.5, 0.0]], dtype=torch.float64)
    slope = torch.tensor([0.4, 0.0, 0.0], dtype=torch.float64)
    torch.testing.assert_close(linear_gradient(x, slope), torch.exp(torch.tensor([-0.2, 0.0, 0.2], dtype=torch.float64)))
    centre = torch.tensor([-1.0, 0.0, 0.0], dtype=torch.float64)
    torch.testing.assert_close(ball_inclusion(x, math.log(3.0), centre, 0.3), torch.tensor([3.0, 1.0, 1.0], dtype=torch.float64))
    width = torch.tensor(0.1, dtype=torch.float64, requires_grad=True)
    soft = ball_inclusion(x, math.log(3.0), centre, 0.3, width=width)
    assert 2.5 < float(soft[0].detach()) < 3.0 and torch.autograd.grad(soft[0], width)[0] != 0


def test_the_library_has_the_vocabulary():
    names = """
        gravity uniform_acceleration drag_linear drag_quadratic magnus position_force time_force viscosity_shear viscosity_bulk maxwell
        hysteresis strain_stiffening second_invariant tension_compression fibre yield hardening softening kinematic_hardening rate_yield
        stiffness_gradient stiffness_change friction stick restitution cohesion added_mass swelling spin_decay
        relaxation_spectrum fractional mullins permanent_set compaction creep nonlinear_backstress cyclic_hardening rate_power
        power_law carreau bingham herschel_bulkley thixotropy
        volumetric geometric_nonlinearity
        dry_friction local_force lift buoyancy bounce_friction bounce_speed
    """.split()
    assert sorted(entry.name for entry in LIBRARY) == sorted(names)
    stages = {"flight", "rotation", "internal modes", "contact", "rest", "power"}
    assert len({entry.title for entry in LIBRARY}) == len(LIBRARY)
    for entry in LIBRARY:
        assert entry.stage in stages and entry.source and entry.equation and entry.title
        assert set(entry.limits) <= set(entry.confusions) <= set(names) - {entry.name}
        for p in entry.parameters:
            assert p.field in (Forces if entry.only == "track" else Effects)._fields and p.low < p.high and p.signed == (p.low < 0.0)


def test_every_name_of_the_library_builds_an_effect():
    x = torch.rand(5, 3, dtype=torch.float64)
    for entry in (entry for entry in LIBRARY if entry.only != "track"):
        for p in entry.parameters:
            effects = Effects.of({f"{entry.name}.{p.name}": 0.5 * p.high}, x=x)
            assert getattr(effects, p.field) is not None, (entry.name, p.name)
    effects = Effects.of({"uniform_acceleration.x": torch.tensor([1.0, 2.0]), "uniform_acceleration.z": 3.0, "drag_linear.k": 0.5})
    torch.testing.assert_close(effects.uniform_acceleration, torch.tensor([[1.0, 0.0, 3.0], [2.0, 0.0, 3.0]]))
    assert effects.drag_linear == 0.5


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"drag.k": 1.0}, "drag.k is not a parameter"),
        ({"viscosity_shear.k": 1.0}, "viscosity_shear.eta"),
        ({"stiffness_gradient.x": 1.0}, "needs the particles' reference positions"),
        ({"time_force.interval": torch.tensor([0.1, 0.2])}, "share one"),
    ],
)
def test_a_wrong_name_is_said(values, message):
    with pytest.raises(UserError, match=re.escape(message)):
        Effects.of(values)


@pytest.mark.parametrize(
    ("effects", "message"),
    [
        (Effects(time_force=torch.zeros(2, 3)), "time_force_interval is None"),
        (Effects(time_force=torch.zeros(2, 2), time_force_interval=0.1), "time_force has shape (2, 2)"),
        (Effects(stick=-1.0), "stick is -1 1/s"),
        (Effects(added_mass=-2.0), "added_mass is -2"),
        (Effects(magnus=torch.ones(3, 3)), "magnus has 3 rows for 1 scenes"),
    ],
)
def test_a_wrong_value_is_said(effects, message):
    with pytest.raises(UserError, match=re.escape(message)):
        flight(effects, 1)
