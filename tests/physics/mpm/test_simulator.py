"""The rollout against its slow twin, finite differences and Warp's own autodiff."""

import pytest
import torch
import warp as wp

from neuido.errors import UserError
from neuido.physics.effects.parameters import Effects
from neuido.physics.laws.classical import DruckerPrager, FixedCorotated, NeoHookean, Sigma, VonMises, stack
from neuido.physics.mpm import reference
from neuido.physics.mpm.kernels import transfers as kernels
from neuido.physics.mpm.plan import Plan
from neuido.physics.mpm.rollout import add_to_grid
from neuido.physics.mpm.simulator import Simulator
from neuido.types import Body, Box, ParticleState, Plane, Scene, Walls
from tests.physics.bodies import DEVICE, DEVICES, block, busy_scenes, same

NAMES = "x v C F mass gravity friction acceleration linear quadratic pull centre shear bulk young poisson yield".split()


def leaf(value, device=DEVICE):
    return torch.as_tensor(value, dtype=torch.float64).clone().to(device).requires_grad_()


class Problem:
    """Two busy scenes with every differentiable input as a leaf."""

    def __init__(self, device=DEVICE):
        scenes, bodies = busy_scenes()
        self.sim = Simulator(scenes, bodies, dtype=torch.float64, device=device)
        g = torch.Generator().manual_seed(3)
        F = self.sim.state.F + 0.05 * torch.randn(self.sim.state.F.shape, generator=g, dtype=torch.float64).to(device)
        self.state = ParticleState(*(leaf(t, device) for t in (*self.sim.state[:3], F)))
        self.mass, self.gravity = leaf(self.sim.mass, device), leaf(self.sim.gravity, device)
        self.friction = leaf(self.sim.colliders.friction, device)
        values = ([0.3, 0.2, 0.1], [0.5, 0.7], [0.2, 0.3], [2.0, 3.0], [[0.5, 0.5, 0.5], [0.2, 0.3, 0.4]], [3.0, 5.0], [2.0, 4.0])
        self.effects = [leaf(v, device) for v in values]
        self.young, self.poisson, self.yield_stress = leaf(5e4, device), leaf(0.3, device), leaf(2e3, device)

    def leaves(self):
        return [*self.state, self.mass, self.gravity, self.friction, *self.effects, self.young, self.poisson, self.yield_stress]

    def laws(self):
        return (
            stack([FixedCorotated(self.young, self.poisson), Sigma(2 * self.young, self.poisson)]),
            stack([VonMises(self.yield_stress, self.young, self.poisson), DruckerPrager(25.0, 2 * self.young, self.poisson)]),
        )

    def loss(self, run, steps, every, **options):
        frames = run(
            steps,
            *self.laws(),
            state=self.state,
            mass=self.mass,
            gravity=self.gravity,
            friction=self.friction,
            effects=Effects(*self.effects),
            every=every,
            **options,
        )
        total = 0.0
        for i, t in enumerate(frames):
            weights = torch.randn(t.shape, generator=torch.Generator().manual_seed(i), dtype=t.dtype)
            total = total + (t * weights.to(t.device)).sum()
        return total, frames


@pytest.mark.parametrize("device", DEVICES)
def test_rollout_equals_its_slow_twin(device):
    p = Problem(device)
    fast, frames = p.loss(p.sim.rollout, 12, 3)
    slow, expected = p.loss(lambda *a, **k: reference.rollout(p.sim, *a, **k), 12, 3)
    for name, a, b in zip("xvCF", frames, expected):
        assert torch.allclose(a, b, rtol=0, atol=1e-11 * float(b.detach().abs().max())), name
    for name, a, b in zip(NAMES, torch.autograd.grad(fast, p.leaves()), torch.autograd.grad(slow, p.leaves()), strict=True):
        assert float((a - b).norm()) <= 1e-9 * float(b.norm()), f"{name}: {float((a - b).norm() / b.norm()):.2e}"
        assert float(b.norm()) > 0, name


def test_rollout_gradient_equals_finite_differences():
    p = Problem()
    gradients = torch.autograd.grad(p.loss(p.sim.rollout, 6, 2)[0], p.leaves())
    for name, t, gradient in zip(NAMES, p.leaves(), gradients, strict=True):
        direction = torch.randn(t.shape, generator=torch.Generator().manual_seed(9), dtype=t.dtype).to(t.device)
        # relative steps; the loss is piecewise smooth in x and F, and a short step stays on its piece; elsewhere a long one rounds off less
        h = (1e-5 if name in "xF" else 1e-4) * float(t.detach().norm() / direction.norm())
        with torch.no_grad():
            values = []
            for shift in (-2, -1, 1, 2):
                t.add_(shift * h * direction)
                values.append(float(p.loss(p.sim.rollout, 6, 2)[0]))
                t.sub_(shift * h * direction)
        numeric = (8 * (values[2] - values[1]) - (values[3] - values[0])) / (12 * h)
        analytic = float((gradient * direction).sum())
        assert abs(numeric - analytic) <= 1e-6 * max(abs(analytic), 1e-3 * abs(float(gradient.norm() * direction.norm()))), name


@pytest.mark.parametrize("contact", [dict(contact="separate"), dict(contact="separate", friction=0.4), dict(contact="slip")])
@pytest.mark.parametrize("slow", [False, True], ids=["kernels", "twin"])
def test_gradient_at_the_branch_of_a_body_that_falls_straight_onto_a_floor(contact, slow):
    """Every node meets the floor at a tangential speed of exactly zero: without friction it slides on, with friction it sticks."""
    body = block((0.3, 0.2, 0.3), (0.7, 0.6, 0.7), (6, 6, 6), velocity=(0.0, -2.0, 0.0))
    scene = Scene(cells=8, dt=1e-3, gravity=(0.0, 0.0, 0.0), walls=None, colliders=(Plane((0.0, 0.4, 0.0), (0.0, 1.0, 0.0), **contact),))
    sim = Simulator(scene, body, dtype=torch.float64, device=DEVICE)
    run = (lambda *a, **k: reference.rollout(sim, *a, **k)) if slow else sim.rollout
    weights = torch.randn(sim.state.v.shape, generator=torch.Generator().manual_seed(5), dtype=torch.float64).to(DEVICE)

    def loss(v):
        return (run(2, FixedCorotated(1e5, 0.3), state=sim.state._replace(v=v), every=2).v[1] * weights).sum()

    v = sim.state.v.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(loss(v), v)
    step = 1e-6
    for axis in (0, 2):
        along = torch.zeros(3, dtype=torch.float64, device=DEVICE)
        along[axis] = step
        with torch.no_grad():
            numeric = float(loss(sim.state.v + along) - loss(sim.state.v - along)) / (2 * step)
        assert abs(numeric - float(gradient[:, axis].sum())) <= 1e-6 * float(weights.abs().sum()), axis
    held = float(gradient[sim.state.x[:, 1] < 0.25, 0].abs().max())
    assert (held > 0.1) == ("friction" not in contact)  # particles whose nodes all lie inside the floor


class Stage:
    """The arrays of one substep of the busy scenes, for one kernel at a time."""

    def __init__(self):
        p = Problem()
        self.sim, self.p = p.sim.setup, p
        self.plan = Plan(p.sim.setup, *p.laws(), 1, 1)
        g = torch.Generator().manual_seed(1)
        self.g = g
        self.state = [t.detach().clone() for t in p.state]
        self.state[2] = self.state[2] + 3.0 * self.random(self.state[2])
        self.tau = 1e3 * self.random(self.state[3])
        self.force = Effects(*(t.detach() for t in p.effects)).force_table(2, p.sim.mass).contiguous()
        self.viscosity = torch.tensor([[3.0, 2.0], [5.0, 4.0]], dtype=torch.float64, device=DEVICE)

    def random(self, t):
        return torch.randn(t.shape, generator=self.g, dtype=torch.float64).to(DEVICE)

    def grid(self):
        x, v, C, _ = self.state
        grid = self.sim.room.scratch("grid").zero_()
        add_to_grid(self.plan, x, v, C, self.tau, self.sim.mass, grid)
        return grid.clone()


def kernel_cases(stage: Stage):
    """Per kernel: inputs by argument name, the differentiable ones, and what it writes."""
    sim = stage.sim
    x, v, C, F = stage.state
    place = {"scene": sim.particles.scene, "origin": sim.origin, "dx": sim.dx, "dt": sim.dt, "nodes": sim.room.size}
    table = sim.colliders
    walls = {"plane": table.plane, "kind": table.kind, "lower": sim.clamp_lower, "upper": sim.clamp_upper}
    grid = stage.grid()
    velocity = torch.zeros_like(grid)
    moving = {"held": sim.held, "step": 0, "status": torch.zeros(3, dtype=torch.int32, device=DEVICE), "span": x.new_zeros(0),
              "lowest": x.new_zeros(len(x)), "since": torch.zeros(len(x), dtype=torch.int32, device=DEVICE),
              "rest_x": None, "rest_F": None}  # fmt: skip
    next_C = torch.zeros_like(C)
    field = 0.5 * stage.random(velocity)
    return {
        "add_viscous_stress": (
            {"scene": sim.particles.scene, "viscosity": stage.viscosity, "C": C, "F": F},
            ["viscosity", "C", "F"],
            {"tau": stage.tau.clone()},
        ),
        "particles_to_grid": (
            {**place, "mass": sim.mass, "volume": sim.volume, "x": x, "v": v, "C": C, "tau": stage.tau},
            ["mass", "x", "v", "C", "tau"],
            {"grid": torch.zeros_like(grid)},
        ),
        "update_grid": (
            {**{k: place[k] for k in ("origin", "dx", "dt")}, "index": sim.room.index, "near": sim.room.near,
             "chunk": sim.room.chunk, **walls, "gravity": sim.gravity.clone(), "force": stage.force,
             "friction": table.friction.clone(), "grid": grid, "clear": False},
            ["gravity", "force", "friction", "grid"],
            {"velocity": velocity},
        ),
        "grid_to_particles": (
            {**place, **moving, "velocity": field, "x": x, "F": F},
            ["velocity", "x", "F"],
            {"x_next": torch.zeros_like(x), "v_next": torch.zeros_like(v), "C_next": next_C, "F_trial": torch.zeros_like(F)},
        ),
    }  # fmt: skip


def launch(stage, kernel, values):
    dim = stage.sim.room.count // stage.sim.room.chunk if "update_grid" in kernel.key else len(stage.sim.mass)
    stage.plan.launch(kernel, dim, [values[arg.label] for arg in kernel.adj.args])


KERNELS = ["add_viscous_stress", "particles_to_grid", "update_grid", "grid_to_particles"]


def hand_adjoint(stage, name, inputs, wanted, outputs, weights):
    """The production adjoint kernel, fed with the gradients `weights` of the outputs."""
    adjoint = getattr(stage.sim.kernels, f"{name}_adjoint")
    values = dict(inputs) | {"parameters": True}
    values |= {f"a_{key}": weights[key].clone() for key in outputs}
    values |= {f"a_{key}": torch.zeros_like(inputs[key]) for key in wanted}
    values |= {key: outputs[key] for key in outputs if key in ("C_next", "v_next")}
    launch(stage, adjoint, values)
    return {key: values[f"a_{key}"] for key in wanted}


@pytest.mark.parametrize("name", KERNELS)
def test_kernel_adjoint_equals_finite_differences(name):
    stage = Stage()
    inputs, wanted, outputs = kernel_cases(stage)[name]
    forward = getattr(stage.sim.kernels, name)

    def run(changes):
        out = {key: t.clone() for key, t in outputs.items()}
        launch(stage, forward, dict(inputs) | changes | out)
        return out

    base = run({})
    weights = {key: stage.random(t) for key, t in outputs.items()}
    analytic = hand_adjoint(stage, name, inputs, wanted, base, weights)
    for key in wanted:
        t = inputs[key]
        direction = stage.random(t)
        if key == "grid":  # only nodes that carry mass, in proportion to what they carry
            direction = direction * t.abs()
        h = 1e-5 * float(t.norm() / direction.norm())
        values = [
            sum(float((out * weights[k]).sum()) for k, out in run({key: t + shift * h * direction}).items()) for shift in (-2, -1, 1, 2)
        ]
        numeric = (8 * (values[2] - values[1]) - (values[3] - values[0])) / (12 * h)
        expected = float((analytic[key] * direction).sum())
        assert abs(numeric - expected) <= 1e-6 * abs(expected) + 1e-9 * float(analytic[key].norm() * direction.norm()), key


@pytest.mark.parametrize("name", KERNELS)
@pytest.mark.slow
def test_kernel_adjoint_equals_warp_autodiff(name):
    """Warp's own adjoint is right here but for the colliders' loop, which carries a value: `update_grid` runs it without planes."""
    stage = Stage()
    inputs, wanted, outputs = kernel_cases(stage)[name]
    if name == "update_grid":
        inputs |= {"plane": torch.where(torch.arange(4, device=DEVICE) == 3, -torch.inf, inputs["plane"])}
    oracle = getattr(kernels.build(wp.float64, enable_backward=True), name)
    weights = {key: stage.random(t) for key, t in outputs.items()}
    forward = {key: t.clone() for key, t in outputs.items()}
    launch(stage, getattr(stage.sim.kernels, name), dict(inputs) | forward)
    analytic = hand_adjoint(stage, name, inputs, wanted, forward, weights)
    arrays = {}
    for arg in oracle.adj.args:
        value = (dict(inputs) | outputs)[arg.label]
        if isinstance(value, torch.Tensor):
            value = wp.from_torch(value.clone(), dtype=arg.type.dtype, requires_grad=arg.label in (*wanted, *outputs))
        arrays[arg.label] = value
    with wp.Tape() as tape:
        dim = stage.sim.room.count // stage.sim.room.chunk if name == "update_grid" else len(stage.sim.mass)
        wp.launch(oracle, dim=dim, inputs=[arrays[arg.label] for arg in oracle.adj.args], device=DEVICE)
    tape.backward(grads={arrays[key]: wp.from_torch(weights[key].clone(), dtype=arrays[key].dtype) for key in outputs})
    for key in set(wanted) - ({"friction"} if name == "update_grid" else set()):
        expected = wp.to_torch(arrays[key].grad).reshape(analytic[key].shape)
        full = torch.ones_like(expected)
        if key == "grid":
            full = (inputs["grid"][..., 3:] > 0).double().expand_as(expected)
        error = float(((analytic[key] - expected) * full).norm() / expected.norm())
        assert error <= 1e-10, f"{key}: {error:.2e}"


@pytest.mark.parametrize("keep", ["state", "all"])
def test_segments_and_tapes_do_not_change_the_gradient(keep):
    p = Problem()
    whole, frames = p.loss(p.sim.rollout, 12, 2)
    expected = torch.autograd.grad(whole, p.leaves())
    other = Simulator(*busy_scenes(), dtype=torch.float64, device=DEVICE, keep=keep)
    for segment in (None, 4, 6):
        parts, again = p.loss(other.rollout, 12, 2, segment=segment)
        assert all(same(a, b) for a, b in zip(frames, again))
        for name, a, b in zip(NAMES, torch.autograd.grad(parts, p.leaves()), expected, strict=True):
            assert float((a - b).norm()) <= 1e-11 * float(b.norm()), f"{name} with {keep}, segment {segment}"


def test_a_later_rollout_does_not_spoil_an_earlier_ones_gradient():
    """Rollouts of one shape share a tape: the earlier one is run again when its gradient is wanted."""
    p = Problem()
    first = p.loss(p.sim.rollout, 8, 2)[0]
    with torch.no_grad():
        expected = first.clone()
    p2 = Problem()
    p2.sim, p2.mass = p.sim, leaf(1.3 * p.sim.mass)
    second = p2.loss(p.sim.rollout, 8, 2)[0]
    a = torch.autograd.grad(first, p.leaves())
    b = torch.autograd.grad(p.loss(p.sim.rollout, 8, 2)[0], p.leaves())
    assert float(second.detach()) != float(expected)
    for name, one, other in zip(NAMES, a, b, strict=True):
        assert float((one - other).norm()) <= 1e-11 * float(other.norm()), name


def test_frames_do_not_depend_on_how_they_are_kept():
    p = Problem()
    with torch.no_grad():
        every = p.loss(p.sim.rollout, 12, 1)[1]
        third = p.loss(p.sim.rollout, 12, 3)[1]
    with_gradient = p.loss(p.sim.rollout, 12, 3)[1]
    for a, b, c in zip(every, third, with_gradient):
        assert same(a[::3], b)
        assert same(b, c)


def test_float32_follows_float64():
    scenes, bodies = busy_scenes()
    law = NeoHookean(5e4, 0.3)
    runs = [Simulator(scenes, bodies, dtype=dtype, device=DEVICE).rollout(20, law, every=20) for dtype in (torch.float32, torch.float64)]
    for name, a, b in zip("xvCF", *runs):
        assert float((a.double() - b).abs().max() / b.abs().max()) < 2e-4, name


@pytest.mark.parametrize("name", ["particles_to_grid", "grid_to_particles"])
def test_sums_over_lanes_equal_the_plain_ones(name):
    """The transfers in float32 have source of their own; those in float64 are Warp's."""
    stage = Stage()
    inputs, _, outputs = kernel_cases(stage)[name]
    plain = {key: t.clone() for key, t in outputs.items()}
    launch(stage, getattr(stage.sim.kernels, name), dict(inputs) | plain)

    def single(values):
        return {k: t.float() if isinstance(t, torch.Tensor) and t.is_floating_point() else t for k, t in values.items()}

    lanes = single(outputs)
    launch(stage, getattr(kernels.build(wp.float32), name), single(inputs) | lanes)
    for key, expected in plain.items():
        assert float(expected.abs().max()) > 0
        assert float((lanes[key].double() - expected).abs().max() / expected.abs().max()) < 1e-5, key


def test_nodes_that_a_substep_empties_are_as_good_as_new():
    """Without a tape the nodes in reach are emptied as they are read; with one each substep has nodes of its own."""
    scene = Scene(cells=16, dt=1e-3, gravity=(0.0, 0.0, 0.0), walls=Walls("slip", 0.0))
    sim = Simulator(scene, block((0.25, 0.375, 0.375), (0.5, 0.625, 0.625), (4, 4, 4), velocity=(3.0, 0.5, 0.0)), device=DEVICE,
                    store="all")  # fmt: skip
    law = FixedCorotated(2e4, 0.3)
    young = torch.tensor(2e4, requires_grad=True)
    taped = [t.detach() for t in sim.rollout(160, FixedCorotated(young, 0.3), every=20)]
    assert float(taped[0][-1, :, 0].min() - taped[0][0, :, 0].max()) > 2 * scene.dx  # far from where it began
    beside = sim.state.x + torch.tensor([scene.dx, 0.0, 0.0], device=DEVICE)  # in nodes to which the body begins with a weight of zero
    bad = sim.state._replace(x=beside, v=sim.state.v * torch.nan)
    with torch.no_grad():
        for _ in range(2):
            assert all(same(a, b) for a, b in zip(taped, sim.rollout(160, law, every=20)))
            with pytest.raises(UserError):  # leaves nodes that are not finite
                sim.rollout(20, law, state=bad, every=20, check=False)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(body=block((0.4, 0.9, 0.4), (0.6, 1.1, 0.6), (2, 2, 2))), "outside the domain"),
        (dict(scene=Scene(cells=32, dt=5e-3)), "lower `dt`"),
        (dict(body=block((0.4, 0.4, 0.4), (0.6, 0.6, 0.6), (2, 2, 2), velocity=(0.0, -70.0, 0.0))), "crosses a cell"),
        (dict(scene=Scene(clamps=(Box((0.0, 0.0, 0.0), (0.1, 0.1, 0.1)),))), "clamp"),
        (dict(scene=Scene(colliders=(Plane((0, 0, 0), (0, 1, 0), "glue"),))), "glue"),
        (dict(scene=Scene(colliders=(Plane((0, 0, 0), (0, 0, 0)),))), "normal"),
        (dict(scene=Scene(walls=Walls("separate", -1.0))), "friction is -1"),
        (dict(density=-3.0), "density is -3"),
        (dict(steps=10, every=3), "multiple of every"),
        (dict(steps=12, every=2, segment=5), "segment is 5"),
        (dict(law=(FixedCorotated(1e5, 0.3), None)), "is of type tuple; give the two laws of a pair one after the other"),
        (dict(law=1e5), "elasticity of a rollout must be a law, and is of type float"),
        (dict(effects=Effects(drag_linear=-1.0)), "drag_linear is -1"),
        (dict(effects=Effects(viscosity_shear=1e5)), r"a shear viscosity of 1e\+05 and a bulk viscosity of 0 Pa s"),
        (dict(effects=Effects(viscosity_shear=300.0, viscosity_bulk=1e5)), r"a shear viscosity of 300 and a bulk viscosity of 1e\+05 Pa s"),
        (dict(scene=Scene(walls=None), body=block((0.4, 0.0, 0.4), (0.6, 0.2, 0.6), (4, 4, 4), velocity=(0.0, -9.0, 0.0)), steps=100),
         "left the domain"),
        (dict(body=Body(torch.tensor([[0.5, float("nan"), 0.5]]), torch.zeros(1, 3), torch.ones(1))), "NaN"),
    ],
)  # fmt: skip
def test_bad_input_is_one_clear_line(change, message):
    body = change.get("body", block((0.4, 0.4, 0.4), (0.6, 0.6, 0.6), (4, 4, 4)))
    with pytest.raises(UserError, match=message) as error:
        sim = Simulator(change.get("scene", Scene()), body, density=change.get("density", 1000.0), device=DEVICE)
        options = {"effects": change.get("effects"), "every": change.get("every", 1), "segment": change.get("segment")}
        sim.rollout(change.get("steps", 10), change.get("law", FixedCorotated(1e5, 0.3)), **options)
    assert "\n" not in str(error.value)


def test_a_step_that_blows_up_is_an_error_not_a_nan():
    sim = Simulator(Scene(cells=16, dt=5e-3), block((0.3, 0.3, 0.3), (0.7, 0.7, 0.7), (6, 6, 6), velocity=(1.0, -3.0, 0.0)), device=DEVICE)
    with pytest.raises(UserError, match="lower `dt`"):
        sim.rollout(400, FixedCorotated(5e6, 0.3), check=False, every=400)


def test_launches_do_not_hold_the_memory_of_their_tensors():
    from neuido.physics.runtime.device import _array

    assert _array(torch.zeros(7, 3), wp.vec3f)._ref is None


@pytest.mark.parametrize("segment", [None, 20])
@pytest.mark.parametrize("device", DEVICES)
def test_scenes_that_fail_are_nan_and_the_others_as_alone(device, segment):
    """One refuses its step, one loses particles, one blows up unchecked: the others are what they are without them."""
    scene = Scene(cells=16, dt=1e-3, walls=None, gravity=(0.0, 0.0, 0.0))
    still = block((0.4, 0.4, 0.4), (0.6, 0.6, 0.6), (4, 4, 4), velocity=(0.1, 0.0, 0.0))
    leaving = still._replace(v=still.v.new_tensor([-20.0, 0.0, 0.0]).expand_as(still.v))
    stretching = still._replace(v=3.0 * (still.x - 0.5))
    young = torch.tensor([5e4, 5e8, 5e4, 7e4])
    sim = Simulator([scene] * 4, [still, stretching, leaving, still], device=device)
    out = sim.rollout(60, FixedCorotated(young, 0.3), every=20, segment=segment, nan_on_failure=True)
    broken = [bool(torch.isnan(t[:, a:b]).all()) for a, b in zip(sim.particles.offsets[:-1], sim.particles.offsets[1:]) for t in out[:1]]
    assert broken == [False, True, True, False]
    for s in (0, 3):
        alone = Simulator(scene, still, device=device).rollout(60, FixedCorotated(young[s], 0.3), every=20)
        for t, one in zip(out, alone, strict=True):
            torch.testing.assert_close(t[:, sim.particles.offsets[s] : sim.particles.offsets[s + 1]], one, atol=1e-5, rtol=1e-5)
    with pytest.raises(UserError, match="in scene 1, above the limit"):
        sim.rollout(60, FixedCorotated(young, 0.3), every=20, segment=segment)
    with pytest.raises(UserError, match=r"of scene [12] "):
        sim.rollout(60, FixedCorotated(young, 0.3), every=20, segment=segment, check=False)
    unchecked = sim.rollout(60, FixedCorotated(young, 0.3), every=20, segment=segment, check=False, nan_on_failure=True)
    assert torch.equal(torch.isnan(unchecked.x), torch.isnan(out.x))
