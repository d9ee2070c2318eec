"""Soak: random short scenes over all laws, effects, bodies, contacts and solvers, each checked against what physics forbids.

    python benchmarks/soak.py --out soak.csv [--scenes 10000] [--seed 0] [--device cpu] [--minutes 0] [--workers 1] [--report soak.md]

A scene depends on the seed and its number alone, and a run goes on behind the rows that the file holds. A scene may be refused in one line;
else it must be finite, keep its momentum where nothing pushes, create no energy, agree with itself in float64, and tell of matter that
turned inside out. `verdict` says what was broken; `--only N` runs one scene again and shows it.
"""

import argparse
import csv
import functools
import math
import multiprocessing
import time
from collections import Counter
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from neuido.data.bodies import shapes
from neuido.errors import UserError
from neuido.physics.effects import LIBRARY as ALL_EFFECTS
from neuido.physics.effects import Effects, ball_inclusion, linear_gradient
from neuido.physics.fem.finite_elements import FiniteElements
from neuido.physics.laws import ElasticLaw, PlasticLaw, material
from neuido.physics.laws.neural.symbolic import SymbolicElastic
from neuido.physics.laws.parametric import lame
from neuido.physics.mpm.simulator import Simulator
from neuido.physics.points.material_point import MODES, Specimen, stress_along
from neuido.physics.runtime.events import COLLAPSED
from neuido.physics.springs.mass_spring import MassSpring, connect
from neuido.types import AttachedMass, Body, Box, Plane, Scene, Walls

COLUMNS = ("scene", "solver", "dtype", "law", "plasticity", "effect", "body", "particles", "contact", "steps", "dt", "outcome", "events",
           "energy_growth", "momentum_error", "float32_error", "seconds", "verdict", "line")  # fmt: skip
SOLVERS = {"material_points": 0.66, "finite_elements": 0.18, "springs": 0.1, "material_point": 0.06}
LAWS = ("fixed_corotated", "neo_hookean", "sigma", "symbolic")
PLASTICITIES = ("identity", "identity", "von_mises", "drucker_prager")
BODIES = ("cube", "box", "ball", "cylinder", "cloud", "one", "pair", "line", "plate", "coincident")
CONTACTS = ("free", "walls", "slip", "sticky", "rough", "slope", "clamped", "weighted")
PUSHING = ("drag_linear", "drag_quadratic", "magnus", "position_force", "time_force", "added_mass", "friction", "stick", "restitution")
"""Effects that change the momentum in free flight, or how it follows from the weight."""
LIFTING = (
    "uniform_acceleration",
    "gravity",
    "magnus",
    "position_force",
    "time_force",
    "added_mass",
    "stiffness_gradient",
    "stiffness_change",
    "swelling",
)
"""Effects that may add energy, or that change what a strain stores."""
GROWTH, DRIFT, PRECISION = 0.05, 2e-4, 0.02
"""Allowed: growth of the energy as a share of what there was, error of the momentum, difference of float32 from float64 in cells."""
LINE = 300

LIBRARY = tuple(entry for entry in ALL_EFFECTS if not entry.only)
"""The effects that bodies have."""


class Case(NamedTuple):
    """A random scene."""

    number: int
    solver: str
    dtype: torch.dtype
    law: str
    plasticity: str
    effect: str
    body: str
    contact: str
    steps: int
    rng: np.random.Generator


def case(seed: int, number: int) -> Case:
    """Return the scene of a number."""
    rng = np.random.default_rng([seed, number])
    solver = str(rng.choice(list(SOLVERS), p=list(SOLVERS.values())))
    effect = "none" if rng.random() < 0.15 else LIBRARY[rng.integers(len(LIBRARY))].name
    plasticity = {"yield": "identity", "cohesion": "drucker_prager", "hardening": "von_mises", "softening": "von_mises",
                  "kinematic_hardening": "von_mises", "rate_yield": "von_mises"}.get(effect, str(rng.choice(PLASTICITIES)))  # fmt: skip
    return Case(number, solver, torch.float32 if rng.random() < 0.7 else torch.float64, str(rng.choice(LAWS)), plasticity,
                effect, str(rng.choice(BODIES, p=[0.25, 0.15, 0.15, 0.1, 0.1, 0.05, 0.05, 0.05, 0.05, 0.05])), str(rng.choice(CONTACTS)),
                int(rng.integers(10, 120)), rng)  # fmt: skip


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(math.exp(rng.uniform(math.log(low), math.log(high))))


def body_of(c: Case) -> Body:
    """Return a body near the middle of the unit cube, often spinning, at 1 mm/s to 8 m/s."""
    rng = c.rng
    centre = tuple(float(a) for a in rng.uniform((0.4, 0.3, 0.4), (0.6, 0.5, 0.6)))
    way = rng.standard_normal(3)
    v = tuple(float(a) for a in way / np.linalg.norm(way) * log_uniform(rng, 1e-3, 8.0))
    given: dict[str, Any] = {"velocity": v, "angular_velocity": tuple(float(a) for a in rng.uniform(-8, 8, 3))}
    if c.body == "cube":
        return shapes.cube(length=float(rng.uniform(0.1, 0.3)), centre=centre, particles_per_side=int(rng.integers(3, 6)), **given)
    if c.body == "box":
        half = rng.uniform(0.05, 0.14, 3)
        lower, upper = (tuple(float(a) for a in centre + sign * half) for sign in (-1, 1))
        return shapes.box(lower=lower, upper=upper, spacing=0.05, jitter=float(rng.choice([0.0, 0.5, 1.0])), seed=c.number, **given)
    if c.body == "ball":
        return shapes.ball(centre=centre, radius=float(rng.uniform(0.06, 0.14)), spacing=0.045, **given)
    if c.body == "cylinder":
        axis = str(rng.choice(["x", "y", "z"]))
        return shapes.cylinder(
            centre=centre, radius=float(rng.uniform(0.06, 0.12)), height=float(rng.uniform(0.08, 0.2)), spacing=0.04, axis=axis, **given
        )
    count = {"cloud": 60, "one": 1, "pair": 2, "line": 6, "plate": 25, "coincident": 12}[c.body]
    spread = 0.08 * rng.standard_normal((count, 3)) if c.body == "cloud" else np.zeros((count, 3))
    if c.body in ("pair", "line"):
        spread[:, 0] = np.linspace(0.0, 0.03 * count, count)
    if c.body == "plate":
        spread[:, (0, 2)] = np.stack(np.meshgrid(np.arange(5), np.arange(5)), -1).reshape(-1, 2) * 0.03
    x = torch.from_numpy(np.clip(centre + spread, 0.15, 0.85))
    return Body(x, torch.tensor(v, dtype=torch.float64).expand(count, 3).contiguous(), torch.full((count,), 3e-5, dtype=torch.float64))


def scene_of(c: Case, body: Body) -> Scene:
    """Return a scene whose step is not chosen yet."""
    rng = c.rng
    walls: dict[str, Any] = {"free": None, "walls": Walls(), "slip": Walls("slip"), "sticky": Walls("sticky", inset=1.0),
                             "rough": Walls("separate", float(rng.choice([0.3, math.inf])))}  # fmt: skip
    given: dict[str, Any] = {"walls": walls.get(c.contact, Walls()), "cells": int(rng.integers(8, 20))}
    given["gravity"] = (0.0, float(rng.choice([0.0, -9.8])), 0.0)
    if c.contact == "slope":
        given["colliders"] = (
            Plane((0.5, 0.2, 0.5), (0.3, 1.0, 0.1), str(rng.choice(["separate", "slip", "sticky"])), float(rng.uniform(0, 1))),
        )
    around = Box(tuple((body.x[0] - 0.02).tolist()), tuple((body.x[0] + 0.02).tolist()))
    if c.contact == "clamped":
        given["clamps"] = (around,)
    if c.contact == "weighted":
        given["attached_masses"] = (AttachedMass(around, log_uniform(rng, 1e-3, 1.0)),)
    return Scene(**given)


def laws_of(c: Case) -> tuple[ElasticLaw, PlasticLaw | None, dict[str, float]]:
    """Return laws, and the moduli of the elastic one."""
    rng = c.rng
    young, poisson = log_uniform(rng, 3e3, 1e6), float(rng.uniform(0.05, 0.45))
    moduli = {"young": young, "poisson": poisson}
    plastic: dict[str, Any] = {"law": c.plasticity}
    if c.plasticity == "von_mises":
        plastic["yield_stress"] = young * log_uniform(rng, 3e-3, 0.3)
    if c.plasticity == "drucker_prager":
        plastic["friction_angle"] = float(rng.uniform(10, 50))
    classical = "sigma" if c.law == "symbolic" else c.law
    elasticity, plasticity = material({"law": classical, **moduli}, plastic)
    if c.law == "symbolic":  # Hencky's law as the neural laws write it
        mu, lam = lame(young, poisson)
        W = torch.zeros(1, 4, 7, dtype=torch.float64)
        W[0, 0, 0], W[0, 1, 0] = (lam + 2 / 3 * mu) / 1e5, 2 * mu / 1e5
        elasticity = SymbolicElastic(W)
    return elasticity, plasticity, moduli


def effects_of(c: Case, x: Tensor, moduli: dict[str, float]) -> tuple[Effects | None, bool]:
    """Return the effect within the ranges of the library, stresses in proportion to the modulus, and whether a figure is negative."""
    rng = c.rng
    if c.effect == "none":
        return None, False
    if c.effect == "stiffness_gradient":
        if rng.random() < 0.5:
            return Effects(stiffness=linear_gradient(x, torch.from_numpy(rng.uniform(-2, 2, 3)).to(x))), False
        return Effects(stiffness=ball_inclusion(x, float(rng.uniform(-2, 2)), torch.zeros(3).to(x), 0.08, width=0.04)), False
    entry = next(own for own in LIBRARY if own.name == c.effect)
    values, negative = {}, False
    for p in entry.parameters:
        top = p.high
        if p.unit == "Pa" and c.effect in ("fibre", "hardening", "kinematic_hardening", "cohesion"):
            top = moduli["young"] * (0.05 if c.effect == "cohesion" else 10.0)
        if p.unit == "1/Pa":
            top = 300.0 / moduli["young"]
        if p.unit == "Pa s":
            top = 1e-3 * moduli["young"]
        size = log_uniform(rng, max(top * 1e-3, p.low if p.low > 0 else 0.0), top)
        values[f"{c.effect}.{p.name}"] = -min(size, -p.low) if p.signed and rng.random() < 0.5 else size
        negative |= values[f"{c.effect}.{p.name}"] < 0
    return Effects.of(values), negative


def stored(law: str, F: Tensor, moduli: dict[str, float]) -> Tensor:
    """Return the elastic energy per volume of a classical law [Pa], (...)."""
    mu, lam = lame(**moduli)
    sigma, J = torch.linalg.svdvals(F.double()), torch.linalg.det(F.double())
    e = sigma.clamp(min=1e-12).log()
    if law == "fixed_corotated":
        return mu * (sigma - 1).square().sum(-1) + lam / 2 * (J - 1).square()
    if law == "neo_hookean":
        return mu / 2 * (sigma.square().sum(-1) - 3) - mu * e.sum(-1) + lam / 2 * e.sum(-1).square()
    return mu * e.square().sum(-1) + lam / 2 * e.sum(-1).square()


def run_body(c: Case, device: str) -> dict[str, Any]:
    """Run a scene of material points or finite elements."""
    body = body_of(c)
    scene, (elasticity, plasticity, moduli) = scene_of(c, body), laws_of(c)
    effects, negative = effects_of(c, body.x, moduli)
    kind: Callable[..., Any] = Simulator if c.solver == "material_points" else FiniteElements
    rough = Simulator(scene, body, device=device, dtype=c.dtype)
    margin = rough.step_margin(1, elasticity, plasticity, effects=effects)
    share = log_uniform(c.rng, 0.05, 1.5) if c.rng.random() < 0.9 else log_uniform(c.rng, 1e-4, 0.05)  # now and then too long, or tiny
    scene = Scene(**{**vars(scene), "dt": min(scene.dt * margin * share, 5e-3)})
    row: dict[str, Any] = {"particles": len(body.x), "dt": scene.dt}
    every = max(c.steps // 10, 1)
    steps = every * (c.steps // every)
    sim = kind(scene, body, device=device, dtype=c.dtype)
    frames = sim.rollout(steps, elasticity, plasticity, effects=effects, every=every)
    events = sorted({event.kind for event in frames.events})
    row |= {"outcome": "ran", "events": " ".join(events)}
    wrong = [] if all(bool(torch.isfinite(t).all()) for t in frames) else ["not finite"]
    J = torch.linalg.det(frames.F.double())
    if bool((J < 0.9 * COLLAPSED).any()) and not {"inverted", "collapsed"} & set(events):
        wrong.append("an inversion without an event")
    resolution = torch.finfo(c.dtype).eps * float(frames.x.abs().max())
    mass, v = sim.mass.double(), frames.v.double()
    time_of = frames.times.to(v.device)
    weight = torch.tensor(scene.gravity, dtype=torch.float64, device=v.device)
    nodal = c.solver == "finite_elements"
    if nodal:  # what is kept is that of the nodes, from which the particles are read
        masses, speeds, places, energies = _elements(sim, c, moduli)
        mass, v = masses, speeds
        time_of = time_of[[0, -1]]
    if c.contact in ("free", "weighted") and c.effect not in (*PUSHING, "uniform_acceleration", "gravity") and _aloof(frames.x, scene):
        p = (mass[:, None] * v).sum(1)
        expected = p[0] + mass.sum() * weight * time_of[:, None]
        scale = float((mass * v.norm(dim=2)).sum(1).max() + (mass.sum() * weight.norm() * time_of[-1])) + 1e-12
        row["momentum_error"] = float((p - expected).norm(dim=1).max()) / scale
        if row["momentum_error"] > DRIFT:
            wrong.append("momentum")
    if c.law != "symbolic" and c.effect not in LIFTING and not negative and not events:
        W = energies if nodal else (stored(c.law, frames.F, moduli) * sim.volume.double()).sum(1)
        kinetic = 0.5 * (mass * v.square().sum(2)).sum(1)
        if not nodal:
            kinetic = kinetic + 0.125 * scene.dx**2 * (mass * frames.C.double().square().sum((2, 3))).sum(1)
        fallen = (mass[:, None] * (places if nodal else frames.x.double()) @ weight[:, None])[..., 0].sum(1)
        total = W + kinetic - fallen
        scale = float(kinetic[0] + (fallen - fallen[0]).abs().max()) + 1e-12
        row["energy_growth"] = float((total - total[0]).max()) / scale
        written = float(mass.sum() * weight.norm() * resolution) / scale  # what the height of a frame tells apart
        if row["energy_growth"] > (GROWTH if share < 0.5 else 4 * GROWTH) + written:  # steps near the limit swing
            wrong.append("energy")
    if c.dtype == torch.float32 and c.rng.random() < 0.3 and not events:
        twin = kind(scene, body, device=device, dtype=torch.float64).rollout(steps, elasticity, plasticity, effects=effects, every=every)
        moved = float((twin.x[-1] - twin.x[0]).norm(dim=1).max())
        size = max(min(moved, scene.dx), 1e-12)
        row["float32_error"] = float((twin.x[-1] - frames.x[-1].double()).norm(dim=1).max()) / size
        if row["float32_error"] > PRECISION + resolution / size and c.contact == "free":
            wrong.append("float32")
    return row | {"verdict": ", ".join(wrong) or "ok"}


def _elements(sim: FiniteElements, c: Case, moduli: dict[str, float]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the masses (N,), velocities and places (2, N, 3) of the nodes and the elastic energy (2,), at the start and at the end."""
    (assembly,) = sim.assemblies
    assert assembly.last is not None
    end = assembly.last[1:]
    assembly.last = None
    start = assembly.start(sim.state)
    held = assembly.held.bool()[:, None]
    x, v, F = (torch.stack([a, b]).double() for a, b in ((start[i], end[i]) for i in (0, 1, 3)))
    energies = (stored(c.law, F, moduli) * assembly.volume.double()).sum(1)
    return assembly.node_mass(sim.mass).double(), torch.where(held, 0.0, v), x, energies


def _aloof(x: Tensor, scene: Scene) -> bool:
    """Whether no particle comes within two cells of the domain's faces."""
    low, high = (torch.tensor(side, dtype=x.dtype, device=x.device) for side in (scene.lower, scene.upper))
    return bool(((x > low + 2 * scene.dx) & (x < high - 2 * scene.dx)).all())


def run_springs(c: Case, device: str) -> dict[str, Any]:
    """Run the body as masses and springs."""
    body, rng = body_of(c), c.rng
    scene = scene_of(c, body)
    x, v = (t.to(device, torch.float64) for t in (body.x, body.v))
    mass = 1000.0 * body.volume.to(device, torch.float64)
    springs = connect(x, int(rng.integers(2, 12)))
    solver = MassSpring(scene, springs, mass, power=float(rng.choice([0.0, 0.5])), dtype=c.dtype)
    k = torch.full((len(springs.pairs),), log_uniform(rng, 1.0, 1e4), dtype=torch.float64, device=x.device)
    damping = torch.full_like(k, float(rng.choice([0.0, log_uniform(rng, 1e-3, 1.0)])))
    step = 2e-3
    parts = solver.substeps(k, damping, step)
    xs, vs = solver.rollout(c.steps * parts, step / parts, x, v, k, damping, torch.tensor(0.5, device=x.device), every=parts)
    row: dict[str, Any] = {"particles": len(x), "dt": step / parts, "outcome": "ran", "law": "springs", "plasticity": "", "effect": ""}
    wrong = [] if bool(torch.isfinite(xs).all() & torch.isfinite(vs).all()) else ["not finite"]
    if solver.power == 0.0:
        total = solver.energy(xs.double(), vs.double(), k)
        scale = (
            float(0.5 * (mass * v.square().sum(1)).sum() + (mass[:, None] * (xs - xs[0]).abs().double()).sum((1, 2)).max() * 9.8) + 1e-12
        )
        row["energy_growth"] = float((total - total[0]).max()) / scale
        planes = solver.planes.double()
        behind = (x @ planes[:, :3].T <= planes[:, 3]) & (solver.kinds != 0)  # contact pushes out what starts behind a plane
        if row["energy_growth"] > GROWTH and not bool(behind.any()):
            wrong.append("energy")
    if scene.walls is None:
        p = (mass[:, None] * vs.double()).sum(1)
        at = torch.arange(len(p), dtype=torch.float64, device=p.device)[:, None] * step
        expected = p[0] + mass.sum() * torch.tensor(scene.gravity, dtype=torch.float64, device=p.device) * at
        row["momentum_error"] = float((p - expected).norm(dim=1).max()) / (float((mass * vs.double().norm(dim=2)).sum(1).max()) + 1e-12)
        if row["momentum_error"] > DRIFT:
            wrong.append("momentum")
    return row | {"verdict": ", ".join(wrong) or "ok"}


def run_specimen(c: Case, device: str) -> dict[str, Any]:
    """Pull a specimen in a testing machine."""
    rng = c.rng
    elasticity, plasticity, moduli = laws_of(c)
    effects, _ = effects_of(c, torch.zeros(1, 3, dtype=torch.float64), moduli)
    mode = str(rng.choice(MODES))
    path = torch.from_numpy(np.exp(rng.uniform(-0.5, 0.8, (8, 2 if mode == "biaxial" else 1))))
    stress = stress_along(Specimen(elasticity, plasticity, effects or Effects(), 1), mode, path, time=torch.linspace(0.1, 1.0, 8).double())
    found = bool(torch.isfinite(stress).all())
    wrong = [] if found or bool(torch.isnan(stress).all()) else ["half a curve"]
    return {
        "particles": 1,
        "outcome": "ran" if found else "no equilibrium",
        "contact": mode,
        "body": "specimen",
        "verdict": ", ".join(wrong) or "ok",
    }


RUNS = {"material_points": run_body, "finite_elements": run_body, "springs": run_springs, "material_point": run_specimen}


def run(seed: int, number: int, device: str) -> dict[str, Any]:
    """Run a scene and return its row."""
    c = case(seed, number)
    row: dict[str, Any] = {"scene": number, "solver": c.solver, "dtype": str(c.dtype).removeprefix("torch."), "law": c.law,
                           "plasticity": c.plasticity, "effect": c.effect, "body": c.body, "contact": c.contact,
                           "steps": c.steps}  # fmt: skip
    start = time.perf_counter()
    try:
        row |= RUNS[c.solver](c, device)
    except UserError as error:
        line = str(error)
        row |= {"outcome": "refused", "line": line, "verdict": "ok" if "\n" not in line and len(line) <= LINE else "a long line"}
    except Exception as error:
        row |= {"outcome": "fault", "line": f"{type(error).__name__}: {error}".splitlines()[0][:LINE], "verdict": "fault"}
    return row | {"seconds": time.perf_counter() - start}


def _run(seed: int, device: str, number: int) -> dict[str, Any]:
    """Run a scene in a process of a pool."""
    return run(seed, number, device)


def report(rows: list[dict[str, str]], path: Path) -> None:
    """Write the table of a run."""

    def share(of: list[dict[str, str]], **like: str) -> str:
        return str(sum(all(row[key] == value for key, value in like.items()) for row in of))

    head = "| {} | scenes | ran | refused | with events | broken |\n| --- | ---: | ---: | ---: | ---: | ---: |\n"
    out = [
        "# Soak\n",
        f"{len(rows)} random scenes. Broken: {Counter(row['verdict'] for row in rows if row['verdict'] != 'ok') or 'none'}.\n",
    ]
    for column in ("solver", "law", "plasticity", "effect", "body", "contact"):
        out.append(head.format(column))
        for value in sorted({row[column] for row in rows if row[column]}):
            own = [row for row in rows if row[column] == value]
            broken = sum(row["verdict"] != "ok" for row in own)
            cells = [
                value,
                str(len(own)),
                share(own, outcome="ran"),
                share(own, outcome="refused"),
                str(sum(bool(r["events"]) for r in own)),
                str(broken),
            ]
            out[-1] += "| " + " | ".join(cells) + " |\n"
    for column, words in (
        ("energy_growth", "growth of the energy"),
        ("momentum_error", "error of the momentum"),
        ("float32_error", "float32 against float64, in cells"),
    ):
        values = sorted(float(row[column]) for row in rows if row[column])
        if values:
            middle, high = values[len(values) // 2], values[int(0.99 * len(values))]
            out.append(f"{words}: median {middle:.2g}, 99 % below {high:.2g}, largest {values[-1]:.2g}, in {len(values)} scenes\n")
    path.write_text("\n".join(out))


def rows_of(numbers: Sequence[int], one: Callable[[int], dict[str, Any]], workers: int) -> Generator[dict[str, Any], None, None]:
    """Yield the rows of scenes as they are done, by several processes; closing it ends them."""
    if workers == 1:
        yield from map(one, numbers)
        return
    with multiprocessing.get_context("spawn").Pool(workers, torch.set_num_threads, (1,)) as pool:
        yield from pool.imap_unordered(one, numbers)


def main() -> None:
    """Run the scenes that are not in the file yet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("soak.csv"))
    parser.add_argument("--report", type=Path)
    parser.add_argument("--scenes", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--minutes", type=float, default=0.0)
    parser.add_argument("--workers", type=int, default=1, help="processes that run scenes side by side")
    parser.add_argument("--only", type=int)
    given = parser.parse_args()
    if given.only is not None:
        print(run(given.seed, given.only, given.device))
        return
    done: set[int] = set()
    if given.out.is_file():
        with given.out.open(newline="") as file:
            done = {int(row["scene"]) for row in csv.DictReader(file) if row["verdict"]}
    end = time.monotonic() + 60.0 * given.minutes if given.minutes else math.inf
    with given.out.open("a", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        if not file.tell():
            writer.writeheader()
        left = [number for number in range(given.scenes) if number not in done]
        rows = rows_of(left, functools.partial(_run, given.seed, given.device), given.workers)
        for row in rows:
            writer.writerow({key: f"{value:.4g}" if isinstance(value, float) else value for key, value in row.items()})
            file.flush()
            if time.monotonic() > end:
                break
        rows.close()
    with given.out.open(newline="") as file:
        found = sorted(csv.DictReader(file), key=lambda row: int(row["scene"]))
    broken = [row for row in found if row["verdict"] != "ok"]
    print(f"{len(found)} scenes, {len(broken)} broken")
    if given.report:
        report(found, given.report)


if __name__ == "__main__":
    main()
