"""Made tests of laboratories: flow curves, small and large oscillations, creep, relaxation after a ramp, and repeated specimens."""

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from neuido.data.undeclared.curve_files import Sizes, drawn_effect, key_rows, write_tests
from neuido.data.undeclared.random_effects import ELASTIC, Redraw, rms, rounded_to_4, truth_entry
from neuido.physics.effects.parameters import Effects
from neuido.physics.effects.point_library import FLUID
from neuido.physics.laws.classical import material
from neuido.physics.points.flow_curve import flow_stress
from neuido.physics.points.material_point import Specimen, complex_modulus, strain_along, stress_along

RELATIVE = 0.01
"""Noise of a flow curve and of moduli, relative to them."""
STRAIN = 3e-3
"""Noise of the strain of a creep test, relative to the largest one."""
RELAXING = ("relaxation_spectrum", "fractional", "viscosity_shear", "hysteresis")
"""Effects that an oscillation shows beside a declared relaxation."""
STRESS = 3e-3
"""Noise of a stress, relative to the largest one."""
SCATTER = 0.03
"""Standard deviation of the stiffness of repeated specimens, relative to it."""
Form = Callable[..., tuple[Callable, dict[str, Any]]]


def form_of(rng: np.random.Generator, kind: str) -> Form | None:
    """Draw the kind of test for an effect; None: a path of strain."""
    forms = [creep_test] if kind == "creep" else [fluid_curves] if kind in FLUID else [None]
    if kind in RELAXING or kind == "none":
        forms.append(oscillation)
    if kind in ("maxwell", "fractional", "none"):
        forms.append(creep_test)
    if kind in ("maxwell", "fractional", "relaxation_spectrum", "none"):
        forms.append(held_ramps)
    if kind in ("maxwell", "viscosity_shear", "hysteresis", "none"):
        forms.append(periodic_cycles)
    if kind in ("strain_stiffening", "second_invariant", "none"):
        forms.append(repeated_specimens)
    if kind == "none":
        forms += [fluid_curves, None]
    return forms[int(rng.integers(len(forms)))] if len(forms) > 1 else forms[0]


def fluid_curves(rng: np.random.Generator, kind: str, ratio: float, name: str, advance: Callable[[int], Any]):
    """Draw flow curves of a fluid: one is fitted, and one at other rates is held out. Thixotropy takes rates up and down in time."""
    viscosity = float(f"{math.exp(rng.uniform(math.log(0.1), math.log(100.0))):.3g}")
    rates = [np.geomspace(0.02, 50.0, 40), np.geomspace(0.05, 120.0, 30)]
    least = viscosity * 0.02
    times: list[np.ndarray | None] = [None, None]
    if kind == "thixotropy":
        rates = [np.concatenate([own, own[-2::-1]]) for own in (np.geomspace(0.1, 50.0, 30), np.geomspace(0.2, 100.0, 30))]
        times = [2.0 * np.arange(len(own)) for own in rates]
    sizes: Sizes = {
        "power_law": ({"n": -0.3, "reference": 1.0}, "n", 0.05, 2),
        "carreau": ({"n": -0.4, "time": rng.uniform(0.3, 3.0)}, "n", 0.05, 2),
        "bingham": ({"yield": 5 * least}, "yield", 0.01, 100),
        "thixotropy": ({"c": 2.0, "breakdown": rng.uniform(0.2, 2.0), "build": 10 ** rng.uniform(-2.0, -1.0)}, "c", 0.02, 30),
        "herschel_bulkley": ({"yield": 10 * least, "n": -rng.uniform(0.3, 0.6), "reference": 1.0}, "yield", 0.01, 100),
    }

    def stresses(values: Mapping[str, float]) -> list[np.ndarray]:
        advance(1)
        given = {key: np.array([value]) for key, value in values.items()}
        return [np.log(flow_stress(np.array([viscosity]), given, *own)[0]) for own in zip(rates, times, strict=True)]

    plain = stresses({})
    drawn = drawn_effect(kind, sizes, ratio * RELATIVE, RELATIVE, lambda values: rms(stresses(values)[0] - plain[0]))
    true = stresses(drawn.values) if drawn else plain
    names, roles = ["curve", "again"], ["fit", "held_out"]
    truth = {
        "undeclared": [truth_entry(drawn, free=("viscosity",))] if drawn else [],
        "measured": "material_test",
        "material": {"flow": "newtonian", "viscosity": viscosity},
        "simulated_with": "the flow curve",
        "noise": RELATIVE,
        "tests": key_rows(true, plain, RELATIVE, roles, names, "1") if drawn else [],
    }
    rows = [np.stack([rate, np.exp(y + RELATIVE * rng.normal(size=len(y)))], axis=1) for rate, y in zip(rates, true, strict=True)]
    declared = float(f"{viscosity * rng.uniform(0.5, 2.0):.3g}")
    model = {"density": 1000.0, "flow": {"law": "newtonian", "viscosity": declared}, "free": ["viscosity"]}
    columns = {"shear_rate": "rate_per_s", "shear_stress": "stress_pa"}
    if times[0] is not None:
        columns = {"time": "time_s"} | columns
        rows = [np.concatenate([t[:, None], own], axis=1) for t, own in zip(times, rows, strict=True)]
    tests = [(n, "flow_curve", role, columns, own) for n, role, own in zip(names, roles, rows, strict=True)]
    return functools.partial(write_tests, name, model, tests), truth


def oscillation(rng: np.random.Generator, kind: str, ratio: float, name: str, advance: Callable[[int], Any]):
    """Draw a sweep of frequencies of a solid with a declared Maxwell branch, and one over other frequencies that is held out."""
    young = float(f"{math.exp(rng.uniform(math.log(1e3), math.log(1e6))):.3g}")
    elasticity = {"law": "neo_hookean", "young": young, "poisson": 0.499}
    own = {"maxwell.ratio": float(f"{rng.uniform(0.5, 3.0):.3g}"), "maxwell.time": float(f"{10 ** rng.uniform(-1.0, 1.0):.3g}")}
    sweeps = [np.geomspace(0.02, 50.0, 30), np.geomspace(0.05, 120.0, 24)]
    law = material(elasticity, {"law": ELASTIC})
    mu = young / (2 * 1.499)
    sizes: Sizes = {
        "viscosity_shear": ({"eta": 0.05 * mu}, "eta", 0.01, 30),
        "hysteresis": ({"eta": 0.15}, "eta", 0.1, 4),
        "fractional": ({"ratio": 0.3, "exponent": rng.uniform(0.15, 0.5), "time": 1.0}, "ratio", 0.02, 20),
        "relaxation_spectrum": ({f"g{i}": float(rng.uniform(0.1, 1.0)) for i in range(1, 6)} | {"first": 0.02, "last": 50.0},
                                "g1 g2 g3 g4 g5", 0.02, 20),
    }  # fmt: skip

    def moduli(values: Mapping[str, float]) -> list[np.ndarray]:
        advance(1)
        specimen = Specimen(*law, Effects.of(own | dict(values)), 1, incompressible=True)
        return [np.log(complex_modulus(specimen, torch.from_numpy(w))[0].numpy()) for w in sweeps]

    plain = moduli({})
    drawn = drawn_effect(kind, sizes, ratio * RELATIVE, RELATIVE, lambda values: rms(moduli(values)[0] - plain[0]))
    true = moduli(drawn.values) if drawn else plain
    names, roles = ["sweep", "again"], ["fit", "held_out"]
    truth = {
        "undeclared": [truth_entry(drawn, free=("young",))] if drawn else [],
        "measured": "material_test",
        "material": {"elasticity": "neo_hookean", "young": young, "poisson": 0.499, **own},
        "simulated_with": "the complex modulus",
        "noise": RELATIVE,
        "tests": key_rows(true, plain, RELATIVE, roles, names, "1") if drawn else [],
    }
    columns = {"angular_frequency": "rad_per_s", "storage_modulus": "storage_pa", "loss_modulus": "loss_pa"}
    tests = [
        (title, "oscillation", role, columns, np.concatenate([w[:, None], np.exp(y + RELATIVE * rng.normal(size=y.shape))], axis=1))
        for title, role, w, y in zip(names, roles, sweeps, true, strict=True)
    ]
    declared = elasticity | {"young": float(f"{young * rng.uniform(0.7, 1.4):.3g}")}
    model = {"density": 1000.0, "elasticity": declared, "plasticity": {"law": ELASTIC}, "effects": own, "free": ["young"],
             "incompressible": True}  # fmt: skip
    return functools.partial(write_tests, name, model, tests), truth


def creep_test(rng: np.random.Generator, kind: str, ratio: float, name: str, advance: Callable[[int], Any]):
    """Draw creep tests in shear under a constant stress: two are fitted, and one under another stress is held out."""
    young = float(f"{math.exp(rng.uniform(math.log(1e4), math.log(1e6))):.3g}")
    elasticity = {"law": "neo_hookean", "young": young, "poisson": 0.499}
    law, mu = material(elasticity, {"law": ELASTIC}), young / (2 * 1.499)
    level = mu * rng.uniform(0.05, 0.15)
    stresses = [level, 2 * level, 1.5 * level]
    times = [np.geomspace(0.1, 100.0, 60) for _ in stresses]
    norm = 2 * level * math.sqrt(3) * math.sqrt(2 / 3)
    sizes: Sizes = {
        "creep": ({"rate": 1e-3, "exponent": rng.uniform(1.0, 4.0), "stress": norm}, "rate", 1e-3, 300),
        "maxwell": ({"ratio": 0.5, "time": 10 ** rng.uniform(0.0, 1.5)}, "ratio", 0.05, 8),
        "fractional": ({"ratio": 0.3, "exponent": rng.uniform(0.15, 0.5), "time": 3.0}, "ratio", 0.05, 20),
    }

    def strains(values: Mapping[str, float]) -> list[np.ndarray]:
        advance(1)
        specimen = Specimen(*law, Effects.of(dict(values)), 1, incompressible=True)
        given = [torch.full((len(t), 1), s, dtype=torch.float64) for s, t in zip(stresses, times, strict=True)]
        pairs = zip(given, times, strict=True)
        found = [strain_along(specimen, "simple_shear", one, time=torch.from_numpy(t))[0, :, 0].numpy() for one, t in pairs]
        if not all(np.isfinite(one).all() for one in found):
            raise Redraw("the strain of the specimen does not converge")
        return found

    plain = strains({})
    noise = STRAIN * max(float(np.abs(one).max()) for one in plain)
    drawn = drawn_effect(kind, sizes, ratio * noise, noise, lambda values: rms(strains(values)[0] - plain[0]))
    true = strains(drawn.values) if drawn else plain
    names, roles = ["low", "high", "between"], ["fit", "fit", "held_out"]
    truth = {
        "undeclared": [truth_entry(drawn, free=("young",))] if drawn else [],
        "measured": "material_test",
        "material": {"elasticity": "neo_hookean", "young": young, "poisson": 0.499},
        "simulated_with": "the law under the stress",
        "noise": noise,
        "tests": key_rows(true, plain, noise, roles, names, "1") if drawn else [],
    }
    columns = {"time": "time_s", "shear_stress": "stress_pa", "shear": "shear"}
    tests = [
        (title, "simple_shear", role, columns, np.stack([t, np.full(len(t), s), e + noise * rng.normal(size=len(t))], axis=1),
         {"control": "stress"})
        for title, role, t, s, e in zip(names, roles, times, stresses, true, strict=True)
    ]  # fmt: skip
    declared = elasticity | {"young": float(f"{young * rng.uniform(0.8, 1.25):.3g}")}
    model = {"density": 1000.0, "elasticity": declared, "plasticity": {"law": ELASTIC}, "free": ["young"], "incompressible": True}
    return functools.partial(write_tests, name, model, tests), truth


class Path(NamedTuple):
    """One test along a path of strain."""

    title: str
    role: str
    mode: str
    strain: np.ndarray
    """Stretch or shear, (n,)."""
    time: np.ndarray | None = None
    periodic: bool = False
    stiffness: float = 1.0
    """Factor on the stress of this specimen."""


def held_ramps(rng: np.random.Generator, kind: str, ratio: float, name: str, advance: Callable[[int], Any]):
    """Draw relaxations after a ramp: two of another speed and stretch are fitted, a third is held out."""
    young = _young(rng)
    hold = np.concatenate([np.linspace(0.0, 1.0, 11), 1.0 + np.geomspace(0.05, 1000.0, 40)])
    paths = []
    for title, role, reach, ramp in (("fast", "fit", 1.3, 0.05), ("slow", "fit", 1.2, 1.0), ("between", "held_out", 1.4, 0.2)):
        rise = np.minimum(hold, 1.0)
        time = ramp * rise + np.maximum(hold - 1.0, 0.0)
        paths.append(Path(title, role, "uniaxial", 1.0 + (reach - 1.0) * rise, time))
    sizes: Sizes = {
        "maxwell": ({"ratio": 0.4, "time": 10 ** rng.uniform(-0.5, 1.5)}, "ratio", 0.02, 8),
        "fractional": ({"ratio": 0.3, "exponent": rng.uniform(0.15, 0.5), "time": 1.0}, "ratio", 0.02, 20),
        "relaxation_spectrum": ({f"g{i}": float(rng.uniform(0.05, 0.4)) for i in range(1, 6)} | {"first": 0.05, "last": 100.0},
                                "g1 g2 g3 g4 g5", 0.02, 20),
    }  # fmt: skip
    return _along(rng, kind, ratio, name, advance, young, paths, sizes)


def periodic_cycles(rng: np.random.Generator, kind: str, ratio: float, name: str, advance: Callable[[int], Any]):
    """Draw large oscillations in their periodic state: two frequencies are fitted, a third one is held out."""
    young = _young(rng)
    phase = 2 * math.pi * np.arange(60) / 60
    paths = []
    for title, role, w, size in (("slow", "fit", 0.3, 0.4), ("fast", "fit", 3.0, 0.3), ("between", "held_out", 1.0, 0.5)):
        paths.append(Path(title, role, "simple_shear", size * np.sin(phase), phase / w, periodic=True))
    sizes: Sizes = {
        "maxwell": ({"ratio": 0.4, "time": 10 ** rng.uniform(-0.5, 0.5)}, "ratio", 0.02, 8),
        "viscosity_shear": ({"eta": 0.02 * young}, "eta", 1e-3, 1e3),
        "hysteresis": ({"eta": 0.15}, "eta", 0.1, 4),
    }
    return _along(rng, kind, ratio, name, advance, young, paths, sizes)


def repeated_specimens(rng: np.random.Generator, kind: str, ratio: float, name: str, advance: Callable[[int], Any]):
    """Draw tensile tests of four specimens of one material, which scatter; one is held out."""
    young = _young(rng)
    stretch = np.linspace(1.0, rng.uniform(1.8, 2.6), 40)
    factors = 1.0 + SCATTER * rng.normal(size=4)
    titles, roles = ("first", "second", "third", "fourth"), ("fit", "fit", "fit", "held_out")
    paths = [Path(t, r, "uniaxial", stretch, stiffness=f) for t, r, f in zip(titles, roles, factors, strict=True)]
    sizes: Sizes = {"strain_stiffening": ({"k": 0.3}, "k", 0.02, 20), "second_invariant": ({"c": 0.3}, "c", 0.02, 15)}
    return _along(rng, kind, ratio, name, advance, young, paths, sizes, scatter=SCATTER)


def _young(rng: np.random.Generator) -> float:
    """Draw the modulus of a rubber [Pa]."""
    return float(f"{math.exp(rng.uniform(math.log(1e4), math.log(1e6))):.3g}")


def _along(
    rng: np.random.Generator, kind: str, ratio: float, name: str, advance: Callable[[int], Any], young: float, paths: Sequence[Path],
    sizes: Sizes, scatter: float = 0.0,
):  # fmt: skip
    """Draw an effect of a rubber, and return the writer of its tests along paths of strain, with the content of the key."""
    elasticity = {"law": "neo_hookean", "young": young, "poisson": 0.499}
    law = material(elasticity, {"law": ELASTIC})

    def stresses(values: Mapping[str, float]) -> list[np.ndarray]:
        advance(1)
        specimen = Specimen(*law, Effects.of(dict(values)), 1, incompressible=True)
        found = []
        for path in paths:
            time = None if path.time is None else torch.from_numpy(path.time)
            strain = torch.from_numpy(path.strain)[:, None]
            found.append(path.stiffness * stress_along(specimen, path.mode, strain, time=time, periodic=path.periodic)[0, :, 0].numpy())
        if not all(np.isfinite(one).all() for one in found):
            raise Redraw("the stress of the specimen does not converge")
        return found

    plain = stresses({})
    noise = STRESS * max(float(np.abs(one).max()) for one in plain)
    floor = math.hypot(noise, scatter * rms(plain[0]))
    drawn = drawn_effect(kind, sizes, ratio * floor, floor, lambda values: rms(stresses(values)[0] - plain[0]))
    true = stresses(drawn.values) if drawn else plain
    titles, roles = [path.title for path in paths], [path.role for path in paths]
    truth = {
        "undeclared": [truth_entry(drawn, free=("young",))] if drawn else [],
        "measured": "material_test",
        "material": {"elasticity": "neo_hookean", "young": young, "poisson": 0.499},
        "simulated_with": "the law along the path",
        "noise": rounded_to_4(noise),
        "tests": key_rows(true, plain, floor, roles, titles, "pa") if drawn else [],
    }
    tests = []
    for path, stress in zip(paths, true, strict=True):
        strain, measured = ("shear", "shear_stress") if path.mode == "simple_shear" else ("stretch", "nominal_stress")
        columns = {strain: strain, measured: "stress_pa"}
        rows = [path.strain, stress + noise * rng.normal(size=len(stress))]
        if path.time is not None:
            columns, rows = {"time": "time_s"} | columns, [path.time, *rows]
        tests.append((path.title, path.mode, path.role, columns, np.stack(rows, axis=1), {"periodic": True} if path.periodic else {}))
    declared = elasticity | {"young": float(f"{young * rng.uniform(0.8, 1.25):.3g}")}
    model = {"density": 1000.0, "elasticity": declared, "plasticity": {"law": ELASTIC}, "free": ["young"], "incompressible": True}
    return functools.partial(write_tests, name, model, tests), truth
