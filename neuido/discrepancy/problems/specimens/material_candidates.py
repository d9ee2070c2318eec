"""The effects that material tests could show, with ranges and starts scaled by the modulus, the applied strain and the times."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch

from neuido.data.measured.material_test import CURVES, MaterialTest, MaterialTests
from neuido.discrepancy.problems.problem import Candidate, Parameter
from neuido.discrepancy.problems.specimens.repeats import shows_ageing, shows_time, stiffness, strain_of, turns_back
from neuido.physics.effects.library import LIBRARY
from neuido.physics.points.rig import turn

STAGES = {
    "strain_stiffening": "large strain", "second_invariant": "biaxiality", "tension_compression": "sign of the strain",
    "fibre": "direction", "compaction": "large compression", "yield": "large strain and reversal", "hardening": "growth of the loop",
    "softening": "unloading and repetition", "mullins": "unloading", "permanent_set": "unloading", "kinematic_hardening": "reversal",
    "nonlinear_backstress": "reversal", "cyclic_hardening": "growth of the loop", "rate_yield": "rate of the flow",
    "rate_power": "rate of the flow", "hysteresis": "loop at every rate", "maxwell": "relaxation", "relaxation_spectrum": "relaxation",
    "fractional": "relaxation", "creep": "time", "viscosity_shear": "rate", "viscosity_bulk": "rate of the volume",
    "stiffness_change": "time", "power_law": "rate", "carreau": "rate", "bingham": "small rates", "herschel_bulkley": "rate",
    "thixotropy": "rate and time",
}  # fmt: skip
"""Stage in which each effect shows."""
ONE_RATE = "one loading at one rate shows no effect of time: an elastic law explains the same"
ONE_LOADING = "the specimen is loaded once, so that a relaxation explains the same"
STEADY = "rates that go one way, or steady ones, show a viscosity and not its memory"
LARGE = 0.1
"""Largest I1 - 3 up to which stiffening and the second invariant act like a change of the shear modulus. Of 57 folders, none gains or loses
a candidate with 0.2, and four creep tests in small shear gain two with 0.05."""
COMPRESSED = 0.25
"""Least logarithmic compression in which compaction can show. Half of it makes no difference to any of 57 folders."""


class _Collection:
    """The candidates of a folder of tests, as they are added."""

    def __init__(self, tests: MaterialTests) -> None:
        self.tests = tests
        self.found: list[Candidate] = []
        self.fixed: dict[str, float] = {}
        """Parameters that are not fitted, with their values."""

    def add(
        self, name: str, starts: Sequence[dict[str, float]], *parameters: tuple, sizes: str = "", linear: bool = True, log: str = "",
        form: str = "", needs: str = "", fixed: dict[str, float] | None = None, beside: Sequence[dict[str, float]] = ({},),
        saturates: str = "",
    ) -> None:  # fmt: skip
        """Add a candidate.

        Args:
            name: The effect.
            starts: Values of its parameters from which fits start.
            parameters: (name, typical step, lower, upper) of each that is fitted.
            sizes: Those that are zero when it is absent; all where empty.
            linear: Whether a small effect is proportional to its size.
            log: Those that are fitted as a logarithm.
            form: Its form, where it has several.
            needs: The effect that must be in the model before.
            fixed: Parameters that are not fitted.
            beside: Values of declared parameters that every start is made with.
            saturates: Parameters with which the effect is complete at their upper bound, so that a fit may end there.
        """
        units = {p.name: p.unit for entry in LIBRARY if entry.name == name for p in entry.parameters}
        fixed = {key: self.tests.effects.get(f"{name}.{key}", value) for key, value in (fixed or {}).items()}
        made = []
        for key, scale, lower, upper in parameters:
            value = self.tests.effects.get(f"{name}.{key}", starts[0][key] if sizes and key not in sizes.split() else 0.0)
            bounds = min(lower, value), max(upper, value)
            complete = key in saturates.split()
            made.append(Parameter(f"{name}.{key}", units[key], value, scale, *bounds, log=key in log.split(), saturates=complete))
        points = tuple(
            {f"{name}.{key}": float(value) for key, value in (start | fixed).items()} | dict(more) for more in beside for start in starts
        )
        own = tuple(f"{name}.{key}" for key in sizes.split())
        self.found.append(Candidate(name, tuple(made), points, STAGES[name], form=form, sizes=own, linear=linear, needs=needs))
        self.fixed |= {f"{name}.{key}": value for key, value in fixed.items()}


def material_candidates(tests: MaterialTests) -> tuple[tuple[Candidate, ...], dict[str, float], dict[str, str]]:
    """Return the effects that these tests could show, their parameters that are not fitted, and the effects that no test here can tell.

    Effects of the rate need times and a hold, a way back or a second rate. Ageing needs a second loading. Hardening needs a yield stress,
    declared or found. Kinematic hardening and softening need a path that turns back, an asymmetry needs stresses of both signs, and a fibre
    needs loads along two axes. Yield is a candidate only where the declared law is elastic.
    """
    if tests.fluid:
        return fluid_candidates(tests)
    c, excluded = _Collection(tests), {}
    fits = [test for test in tests.tests if test.role == "fit"]
    paths = [test for test in fits if test.mode not in CURVES]
    young, poisson = (float(tests.model["elasticity"][key]) for key in ("young", "poisson"))
    mu = young / (2 * (1 + poisson))
    seen = stiffness(fits, poisson) or young
    strains = [strain_of(test) for test in paths] or [np.zeros((2, 1))]
    largest = max(max(float(np.abs(e).max()) for e in strains), 1e-6)
    stress = max([float(np.abs(test.stress).max()) * (np.sqrt(3) if test.mode == "simple_shear" else 1.0) for test in paths], default=mu)
    if paths:
        _elastic(c, paths, young, mu, stress, largest)
    if paths or c.tests.effects:
        _plastic(c, paths, mu, stress, largest, {"young": seen} if seen > young and "young" in tests.free else {})
    if all(test.time is not None or test.mode in CURVES for test in tests.tests):
        names = ("viscosity_shear", "viscosity_bulk", "maxwell", "relaxation_spectrum", "fractional", "hysteresis", "creep")
        if shows_time(fits):
            _timed(c, fits, strains, mu, stress)
        else:
            excluded |= dict.fromkeys(names, ONE_RATE)
        if not paths:
            pass
        elif shows_ageing(paths):
            duration = max(float(np.ptp(test.time)) for test in paths)  # type: ignore[arg-type]
            c.add("stiffness_change", [{"rate": 0.1 / duration}], ("rate", 0.1 / duration, -3 / duration, 3 / duration))
        else:
            excluded["stiffness_change"] = ONE_LOADING
    return tuple(c.found), c.fixed, excluded


def _elastic(c: _Collection, fits: Sequence[MaterialTest], young: float, mu: float, stress: float, largest: float) -> None:
    """Add what a law lacks that has neither history nor time."""
    tests, reach = c.tests, max(_reach(test) for test in fits)
    k = 0.3 / reach
    if reach > LARGE:
        c.add("strain_stiffening", [{"k": k}, {"k": k / 10}], ("k", k, -10 * k, 10 * k), linear=False)
        c.add("second_invariant", [{"c": 0.2}], ("c", 0.2, -0.5, 5.0))
    ends = [end for test in tests.tests if test.mode not in CURVES for end in (float(test.stress.min()), float(test.stress.max()))]
    if min(ends) < -0.1 * stress and max(ends) > 0.1 * stress:
        c.add("tension_compression", [{"r": 0.3}], ("r", 0.2, -0.7, 3.0))
    squeezed = -min(float(strain_of(test).min()) for test in fits if test.mode != "simple_shear") if _stretched(fits) else 0.0
    if squeezed > COMPRESSED and not tests.incompressible:  # what keeps its volume does not compact
        starts = [{"k": 0.3, "lock": f * squeezed} for f in (1.1, 1.6)]
        c.add("compaction", starts, ("k", 0.3, 0.0, 50.0), ("lock", 0.1, 1.02 * squeezed, 5.0), sizes="k", log="lock")
    angles = _angles(tests)
    if angles:
        grid = np.stack(np.meshgrid(*(np.arange(4) * np.pi / 4 for _ in angles)), -1).reshape(-1, len(angles))
        c.add("fibre", [{"c": 0.3 * mu} | dict(zip(angles, map(float, at), strict=True)) for at in grid],
              ("c", 0.2 * mu, 0.0, 30 * mu), *((a, 0.2, -2 * np.pi, 2 * np.pi) for a in angles), sizes="c")  # fmt: skip


def _plastic(c: _Collection, paths: Sequence[MaterialTest], mu: float, stress: float, largest: float, stiff: dict[str, float]) -> None:
    """Add yield, what may come with it, and damage."""
    plasticity = c.tests.model["plasticity"]["law"]
    travelled = max((float(np.abs(np.diff(strain_of(test), axis=0)).sum(axis=0).max()) for test in paths), default=largest)
    unloads = any(turns_back(test) for test in c.tests.tests if test.mode not in CURVES and test.control == "strain")
    norm = stress * np.sqrt(2 / 3)
    if plasticity == "identity" and paths:
        starts = [{"inverse": f / norm} for f in (1.1, 1.5, 3.0)]
        c.add("yield", starts, ("inverse", 0.3, 1e-3 / norm, 30 / norm), sizes="inverse", linear=False, log="inverse",
              beside=({}, stiff) if stiff else ({},))  # fmt: skip
    if unloads and plasticity != "drucker_prager":
        c.add("softening", [{"s": 0.3 / travelled}], ("s", 0.3 / largest, 0.0, 10 / largest))
    if unloads and plasticity == "identity":
        c.add("mullins", [{"share": 0.3, "width": w} for w in (0.2, 1.0)], ("share", 0.1, 0.0, 0.95), ("width", 0.3, 0.02, 5.0),
              sizes="share", log="width")  # fmt: skip
        c.add("permanent_set", [{"share": 0.1}], ("share", 0.05, 0.0, 0.8))
    if plasticity == "drucker_prager" or not paths:
        return
    needs = "" if plasticity == "von_mises" else "yield"
    flow = float(c.tests.model["plasticity"]["yield_stress"]) if plasticity == "von_mises" else norm
    h, top = flow / largest, max(2 * mu, 2 * stress / largest)
    slow = h * largest / max(travelled, largest)
    c.add("hardening", [{"h": 0.1 * slow}, {"h": slow}], ("h", slow, 0.0, top), needs=needs)
    b = [f / max(travelled, largest) for f in (2.0, 20.0)]
    c.add("cyclic_hardening", [{"q": sign * 0.2 * flow, "b": one} for one in b for sign in (1, -1)],
          ("q", 0.1 * flow, -0.95 * flow, 3 * flow), ("b", 0.3, 0.1 * b[0], 100 * b[1]), sizes="q", log="b", needs=needs)  # fmt: skip
    if unloads:
        c.add("kinematic_hardening", [{"h": 0.03 * h}, {"h": 0.3 * h}], ("h", 0.3 * h, 0.0, top), needs=needs)
        for form, fading in (("one", (3.0,)), ("two", (20.0, 2.0)), ("three", (50.0, 8.0, 0.5))):
            starts = [dict(_fading(fading, factor, flow, largest)) for factor in (1.0, 4.0)]
            own: list[tuple] = []
            for i, fade in enumerate(fading):
                own += [(f"h{i + 1}", 0.2 * flow * fade / largest, 0.0, 1e3 * top), (f"g{i + 1}", 0.3, 1e-3 / largest, 1e4 / largest)]
            c.add("nonlinear_backstress", starts, *own, sizes=" ".join(f"h{i + 1}" for i in range(len(fading))),
                  log=" ".join(f"g{i + 1}" for i in range(len(fading))), form=form, needs=needs)  # fmt: skip
    if all(test.time is not None for test in paths):
        speed = max(float(np.abs(np.diff(strain_of(test), axis=0) / np.diff(test.time)[:, None]).max()) for test in paths)  # type: ignore[arg-type]
        eta = max(stress, flow) / max(speed, 1e-12)
        c.add("rate_yield", [{"eta": 0.02 * eta}], ("eta", 0.03 * eta, 0.0, 3 * eta), needs=needs)
        consistency = {n: 0.2 * flow / max(speed, 1e-12) ** n for n in (0.5, 0.2)}
        c.add("rate_power", [{"k": k, "n": n} for n, k in consistency.items()],
              ("k", 0.3, 1e-4 * min(consistency.values()), 1e3 * max(consistency.values())), ("n", 0.2, 0.03, 1.2),
              sizes="k", log="k n", linear=False, needs=needs)  # fmt: skip


def _fading(fading: Sequence[float], factor: float, flow: float, largest: float) -> Iterator[tuple[str, float]]:
    """Yield h and g of backstresses that together saturate at half of the yield stress, each within its share of the largest strain."""
    for i, fade in enumerate(fading):
        g = factor * fade / largest
        yield f"g{i + 1}", g
        yield f"h{i + 1}", 0.5 * flow * g / len(fading)


def _timed(c: _Collection, fits: Sequence[MaterialTest], strains: Sequence[np.ndarray], mu: float, stress: float) -> None:
    """Add what depends on the rate or on time."""
    tests = c.tests
    shortest, duration = 1e300, 0.0
    for test in fits:
        if test.mode == "oscillation":
            shortest, duration = min(shortest, 1 / float(test.path.max())), max(duration, 1 / float(test.path.min()))
        else:
            shortest = min(shortest, float(np.diff(test.time).min()))  # type: ignore[arg-type]
            duration = max(duration, float(np.ptp(test.time)))  # type: ignore[arg-type]
    paths = [test for test in fits if test.mode not in CURVES]
    speeds = [np.abs(np.diff(e, axis=0) / np.diff(test.time)[:, None]).max() for e, test in zip(strains, paths, strict=False)]  # type: ignore[arg-type]
    eta = stress / max(float(max(speeds)) if speeds else 1 / duration, 1e-12)
    c.add("viscosity_shear", [{"eta": 0.02 * eta}], ("eta", 0.03 * eta, 0.0, 3 * eta))
    if not tests.incompressible and paths:
        c.add("viscosity_bulk", [{"zeta": 0.1 * eta}], ("zeta", 0.1 * eta, 0.0, 30 * eta))
    c.add("maxwell", [{"ratio": 0.3, "time": t} for t in np.geomspace(shortest, duration, 4)],
          ("ratio", 0.2, 0.0, 20.0), ("time", 0.5, 0.1 * shortest, 20 * duration), sizes="ratio", log="time")  # fmt: skip
    c.add("hysteresis", [{"eta": 0.1}], ("eta", 0.05, 0.0, 1.0))
    if duration > 30 * shortest:
        most = 1e4 if not paths or any(test.control == "stress" for test in paths) else 50.0  # a melt relaxes all but a trace
        names, every = [f"g{i}" for i in range(1, 6)], "g1 g2 g3 g4 g5"
        fixed = {"first": shortest, "last": duration}
        if paths:
            own = [(g, 0.1, 0.0, most) for g in names]
            c.add("relaxation_spectrum", [dict.fromkeys(names, 0.1)], *own, sizes=every, fixed=fixed, saturates=every)
        else:  # moduli span decades, and so do the weights
            falls = [dict(zip(names, np.geomspace(high, 1.0, 5), strict=True)) for high in (1.0, 30.0, 1e3)]
            own = [(g, 0.5, 1e-3, most) for g in names]
            c.add("relaxation_spectrum", falls, *own, sizes=every, log=every, linear=False, fixed=fixed, saturates=every)
        c.add("fractional", [{"ratio": 0.3, "exponent": a} for a in (0.15, 0.5)], ("ratio", 0.2, 0.0, most), ("exponent", 0.1, 0.03, 0.95),
              sizes="ratio", log="exponent", fixed={"time": float(np.sqrt(shortest * duration))}, saturates="ratio")  # fmt: skip
    if tests.model["plasticity"]["law"] == "identity":
        norm = max(stress * np.sqrt(2 / 3), 1e-6)
        rate = norm / (2 * mu) / duration
        exponents = (1.0,) if not paths else (1.0, 3.0)
        crept = _crept(paths, float(tests.model["elasticity"]["poisson"]))
        rates, beside = (0.3 * rate, 9.0 * rate), ({},)
        if crept is not None:
            rates, beside = (crept[1],), ({}, {"young": crept[0]}) if "young" in tests.free else ({},)
        shape = () if not paths else (("exponent", 0.3, 0.5, 15.0),)
        typical = 0.3 * rate if crept is None else crept[1]
        c.add("creep", [{"rate": r, "exponent": n} for n in exponents for r in rates],
              ("rate", 0.5, 1e-4 * typical, 1e5 * typical), *shape, sizes="rate", log="rate exponent", linear=False,
              fixed={"stress": float(norm)} | ({"exponent": 1.0} if not paths else {}), beside=beside)  # fmt: skip


def _crept(tests: Sequence[MaterialTest], poisson: float) -> tuple[float, float] | None:
    """Return the modulus that a specimen shows at once under a prescribed stress [Pa], and its rate of flow at the end [1/s].

    The rate is the norm of the plastic strain rate in the last fifth of the test. None where no test prescribes the stress.
    """
    found = []
    for test in tests:
        e, t = strain_of(test)[:, 0], test.time
        if test.control != "stress" or t is None or e[0] * test.stress[0, 0] <= 0:
            continue
        shear = test.mode == "simple_shear"
        late = t >= t[-1] - 0.2 * np.ptp(t)
        if late.sum() < 3:
            continue
        slope = abs(float(np.polyfit(t[late], e[late], 1)[0]))
        young = float(test.stress[0, 0] / e[0]) * (2 * (1 + poisson) if shear else 1.0)
        found.append((young, max(slope * np.sqrt(0.5 if shear else 1.5), 1e-12)))
    return (float(np.median([y for y, _ in found])), float(max(r for _, r in found))) if found else None


def fluid_candidates(tests: MaterialTests) -> tuple[tuple[Candidate, ...], dict[str, float], dict[str, str]]:
    """Return what a declared Newtonian fluid may lack; see `material_candidates`."""
    c = _Collection(tests)
    fits = [test for test in tests.tests if test.role == "fit"]
    rates = np.concatenate([test.path[:, 0] for test in fits])
    low, high, middle = float(rates.min()), float(rates.max()), float(np.exp(np.log(rates).mean()))
    stress = np.concatenate([test.stress[:, 0] for test in fits])
    least, typical = float(stress.min()), float(np.exp(np.log(stress).mean()))
    fixed = {"reference": middle}
    c.add("power_law", [{"n": -0.3}, {"n": 0.2}], ("n", 0.1, -0.98, 1.0), fixed=fixed)
    c.add("carreau", [{"n": -0.4, "time": 1 / r} for r in (low, middle, high)], ("n", 0.1, -0.98, 1.0),
          ("time", 0.5, 0.01 / high, 100 / low), sizes="n", log="time")  # fmt: skip
    yields = [f * least for f in (0.3, 0.9)]
    c.add("bingham", [{"yield": y} for y in yields], ("yield", 0.2, 1e-4 * least, 3 * typical), sizes="yield", log="yield", linear=False)
    c.add("herschel_bulkley", [{"yield": y, "n": n} for y in yields for n in (-0.5, -0.2)], ("yield", 0.2, 1e-4 * least, 3 * typical),
          ("n", 0.1, -0.98, 1.0), sizes="yield n", log="yield", linear=False, fixed=fixed)  # fmt: skip
    timed = [test for test in fits if test.time is not None and turns_back(test)]
    if not timed:
        return tuple(c.found), c.fixed, {"thixotropy": STEADY}
    build = 3 / max(float(np.ptp(test.time)) for test in timed)  # type: ignore[arg-type]
    c.add("thixotropy", [{"c": size, "breakdown": 1 / middle, "build": build} for size in (1.0, 10.0)], ("c", 0.5, 0.0, 1e5),
          ("breakdown", 0.5, 0.01 / high, 100 / low), ("build", 0.5, 1e-3 * build, 1e4 * build), sizes="c",
          log="breakdown build")  # fmt: skip
    return tuple(c.found), c.fixed, {}


def _stretched(fits: Sequence[MaterialTest]) -> bool:
    return any(test.mode != "simple_shear" for test in fits)


def _reach(test: MaterialTest) -> float:
    """Return the largest I1 - 3 of a test at constant volume, with I1 the first invariant of the Cauchy-Green tensor."""
    if test.mode == "simple_shear":
        return max(float((test.path**2).max()), 1e-6)
    first = test.path[:, 0]
    second: Any = {"uniaxial": first**-0.5, "equibiaxial": first, "pure_shear": np.ones_like(first), "biaxial": test.path[:, -1]}[test.mode]
    return max(float((first**2 + second**2 + (first * second) ** -2).max()) - 3, 1e-6)


def _angles(tests: MaterialTests) -> list[str]:
    """Return the angles of a fibre that these tests can determine, in the plane of their loading axes.

    The list is empty where all tests load along one axis: a fibre then looks like any other stiffening.
    """
    frames = [(test, turn(torch.tensor(test.direction, dtype=torch.float64)).numpy()) for test in tests.tests]
    d = np.array([R[:, 0] for _, R in frames] + [R[:, 1] for test, R in frames if test.mode in ("biaxial", "pure_shear")])
    if np.linalg.matrix_rank(d, tol=1e-6) < 2:
        return []
    if (np.abs(d[:, 2]) < 1e-9).all():
        return ["elevation"]  # in the plane x, y
    return ["azimuth"] if (np.abs(d[:, 1]) < 1e-9).all() else ["azimuth", "elevation"]
