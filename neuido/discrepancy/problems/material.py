"""Material tests as a `Problem`: the declared law along the measured stretch or shear, and the effects that it may lack."""

import math
import os
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from neuido.data.measured.material_test import MaterialTest, MaterialTests, read_material_tests
from neuido.discrepancy.problems.declared_model import declared
from neuido.discrepancy.problems.noise import high_pass, monotone_pieces, surface
from neuido.discrepancy.problems.problem import Candidate, Parameter, Point, Problem, Recording
from neuido.errors import UserError
from neuido.physics.effects.parameters import LIBRARY, Effects
from neuido.physics.laws.classical import material
from neuido.physics.points.material_point import Specimen, stress_along, turn

STAGES = {
    "strain_stiffening": "large strain",
    "second_invariant": "biaxiality",
    "tension_compression": "sign of the strain",
    "fibre": "direction",
    "yield": "large strain and reversal",
    "hardening": "growth of the loop",
    "softening": "unloading and repetition",
    "kinematic_hardening": "reversal",
    "rate_yield": "rate of the flow",
    "hysteresis": "loop at every rate",
    "maxwell": "relaxation",
    "viscosity_shear": "rate",
    "viscosity_bulk": "rate of the volume",
    "stiffness_change": "time",
}
"""Stage in which each effect shows."""
MOST_POINTS = 256
"""Largest number of parameter sets per batch."""


class MaterialProblem(Problem):
    """Tests of one material, from a folder of the format `neuido-material-test/1` or read already.

    There is one setting, because nothing is discretised: steps of a path with a history are exact for proportional loading and subdivided
    otherwise. A held-out test that continues with the same specimen is predicted with the history of the tests before it.
    """

    def __init__(self, folder: str | os.PathLike | MaterialTests) -> None:
        tests = folder if isinstance(folder, MaterialTests) else read_material_tests(folder)
        law = tests.model["elasticity"] | tests.model["plasticity"]
        free = tuple(declared(name, law[name]) for name in tests.free if name != "density")
        chains = tests.histories()
        noises = [_noise_in(tests, next(chain for chain in chains if i in chain), i) for i in range(len(tests.tests))]
        super().__init__(
            name=tests.name,
            measure="rmse",
            unit="Pa",
            declared=free,
            nuisances=(),
            candidates=material_candidates(tests),
            recordings=tuple(_recording(test, noise) for test, noise in zip(tests.tests, noises, strict=True)),
            labels={"kind": "material test"},
        )
        self.tests = tests
        self._chains = chains
        self._partners = {p.name: p.value for c in self.candidates for p in c.parameters} | tests.effects

    def predict(self, points: Sequence[Point], recording: int, setting: int = 0) -> np.ndarray:
        n = len(self.recordings[recording].y)
        if len(points) > MOST_POINTS:
            parts = [self.predict(points[i : i + MOST_POINTS], recording) for i in range(0, len(points), MOST_POINTS)]
            return np.concatenate(parts)
        if not points:
            return np.empty((0, n))
        chain = next(chain for chain in self._chains if recording in chain)
        specimen = [self.tests.tests[i] for i in chain[: chain.index(recording) + 1]]
        last = specimen[-1]
        path = torch.from_numpy(np.concatenate([test.path for test in specimen]))
        time = None if last.time is None else torch.from_numpy(np.concatenate([test.time for test in specimen]))
        try:
            out = stress_along(self._specimen(points), last.mode, path, direction=last.direction, time=time, true_stress=last.true_stress)
        except UserError:  # one parameter set that the law refuses fails the whole batch
            if len(points) == 1:
                return np.full((1, n), np.nan)
            return np.concatenate([self.predict([point], recording) for point in points])
        return out[:, -len(last.path) :].reshape(len(points), -1).numpy()

    def _specimen(self, points: Sequence[Point]) -> Specimen:
        """Build a specimen with the laws and effects of several parameter sets."""

        def rows(name: str, absent: float) -> torch.Tensor:
            return torch.tensor([float(point.get(name, absent)) for point in points], dtype=torch.float64)

        sections = []
        for part in ("elasticity", "plasticity"):
            section = dict(self.tests.model[part])
            for p in self.declared:
                if p.name in section:
                    section[p.name] = rows(p.name, p.value)
            sections.append(section)
        effects = self.tests.effects | {name: 0.0 for point in points for name in point if "." in name}
        amounts = {entry.name: f"{entry.name}.{entry.parameters[0].name}" for entry in LIBRARY}
        values = {}
        for effect in dict.fromkeys(name.partition(".")[0] for name in effects):
            if not bool(rows(amounts[effect], self._partners.get(amounts[effect], 0.0)).any()):
                continue  # absent in every parameter set
            own = [p.name for entry in LIBRARY if entry.name == effect for p in entry.parameters]
            for name in (f"{effect}.{part}" for part in own):
                if name in effects or name in self._partners:
                    values[name] = rows(name, self._partners.get(name, 0.0))
        elasticity, plasticity = material(*sections)
        return Specimen(elasticity, plasticity, Effects.of(values), len(points), self.tests.incompressible)

    def model_after(self, values: Point, effects: Sequence[str]) -> dict[str, Any]:
        model: dict[str, Any] = {key: dict(part) if isinstance(part, dict) else part for key, part in self.tests.model.items()}
        for p in self.declared:
            for part in ("elasticity", "plasticity"):
                if p.name in model[part]:
                    model[part][p.name] = float(values.get(p.name, p.value))
        model["free"] = list(self.tests.free)
        if self.tests.incompressible:
            model["incompressible"] = True
        own = {p.name: p.value for c in self.candidates if c.name in effects for p in c.parameters}
        own |= {name: float(value) for name, value in values.items() if name.partition(".")[0] in effects}
        if self.tests.effects or own:
            model["effects"] = self.tests.effects | own
        return model


def material_candidates(tests: MaterialTests) -> tuple[Candidate, ...]:
    """Return the effects that these tests could show, with ranges and starts scaled by the modulus and the applied strain.

    Effects of the rate need times, and hardening needs a declared yield stress. Kinematic hardening and softening need a path that
    turns back, an asymmetry needs stresses of both signs, and a fibre needs loads along two axes. Yield is a candidate only where the
    declared law is elastic.
    """
    fits = [test for test in tests.tests if test.role == "fit"]
    young, poisson = (float(tests.model["elasticity"][key]) for key in ("young", "poisson"))
    mu = young / (2 * (1 + poisson))
    strains = [test.path if test.mode == "simple_shear" else np.log(test.path) for test in fits]
    largest = max(max(float(np.abs(e).max()) for e in strains), 1e-6)
    travelled = max(float(np.abs(np.diff(e, axis=0)).sum(axis=0).max()) for e in strains)
    stress = max(float(np.abs(test.stress).max()) for test in fits)
    reach = max(_reach(test) for test in fits)
    out: list[Candidate] = []

    def add(name: str, starts: Sequence[dict[str, float]], *parameters: tuple, sizes: str = "", linear: bool = True, log: str = "") -> None:
        """Add a candidate with parameters (name, typical step, lower, upper); `sizes` are zero when it is absent (all where empty)."""
        units = {p.name: p.unit for entry in LIBRARY if entry.name == name for p in entry.parameters}
        made = []
        for key, scale, lower, upper in parameters:
            value = tests.effects.get(f"{name}.{key}", starts[0][key] if sizes and key not in sizes.split() else 0.0)
            made.append(Parameter(f"{name}.{key}", units[key], value, scale, min(lower, value), max(upper, value), log=key == log))
        points = tuple({f"{name}.{key}": float(value) for key, value in start.items()} for start in starts)
        out.append(Candidate(name, tuple(made), points, STAGES[name], sizes=tuple(f"{name}.{key}" for key in sizes.split()), linear=linear))

    k = 0.3 / reach
    if reach > 0.1:  # at smaller strains both act like a change of the shear modulus
        add("strain_stiffening", [{"k": k}, {"k": k / 10}], ("k", k, -10 * k, 10 * k), linear=False)
        add("second_invariant", [{"c": 0.2}], ("c", 0.2, -0.5, 5.0))
    ends = [end for test in tests.tests for end in (float(test.stress.min()), float(test.stress.max()))]
    if min(ends) < -0.1 * stress and max(ends) > 0.1 * stress:
        add("tension_compression", [{"r": 0.3}], ("r", 0.2, -0.7, 3.0))
    angles = _angles(tests)
    if angles:
        grid = np.stack(np.meshgrid(*(np.arange(4) * np.pi / 4 for _ in angles)), -1).reshape(-1, len(angles))
        add("fibre", [{"c": 0.3 * mu} | dict(zip(angles, map(float, at), strict=True)) for at in grid],
            ("c", 0.2 * mu, 0.0, 30 * mu), *((a, 0.2, -2 * np.pi, 2 * np.pi) for a in angles), sizes="c")  # fmt: skip
    plasticity = tests.model["plasticity"]["law"]
    unloads = any(_unloads(test) for test in tests.tests)
    if plasticity == "identity":
        norm = stress * np.sqrt(2 / 3)
        starts = [{"inverse": f / norm} for f in (1.1, 1.5, 3.0)]
        add("yield", starts, ("inverse", 0.3, 1e-3 / norm, 30 / norm), sizes="inverse", linear=False, log="inverse")
    if unloads and plasticity != "drucker_prager":
        add("softening", [{"s": 0.3 / travelled}], ("s", 0.3 / largest, 0.0, 10 / largest))
    if plasticity == "von_mises":
        h = float(tests.model["plasticity"]["yield_stress"]) / largest
        slow = h * largest / travelled
        add("hardening", [{"h": 0.1 * slow}, {"h": slow}], ("h", slow, 0.0, 2 * mu))
        if unloads:
            add("kinematic_hardening", [{"h": 0.03 * h}, {"h": 0.3 * h}], ("h", 0.3 * h, 0.0, 2 * mu))
    if all(test.time is not None for test in tests.tests):
        duration = max(float(np.ptp(test.time)) for test in fits)
        shortest = min(float(np.diff(test.time).min()) for test in fits)
        rate = max(float(np.abs(np.diff(e, axis=0) / np.diff(test.time)[:, None]).max()) for e, test in zip(strains, fits, strict=True))
        eta = stress / max(rate, 1e-12)
        add("viscosity_shear", [{"eta": 0.02 * eta}], ("eta", 0.03 * eta, 0.0, 3 * eta))
        if not tests.incompressible:
            add("viscosity_bulk", [{"zeta": 0.1 * eta}], ("zeta", 0.1 * eta, 0.0, 30 * eta))
        add("maxwell", [{"ratio": 0.3, "time": t} for t in np.geomspace(shortest, duration, 4)],
            ("ratio", 0.2, 0.0, 20.0), ("time", 0.5, 0.1 * shortest, 20 * duration), sizes="ratio", log="time")  # fmt: skip
        add("hysteresis", [{"eta": 0.1}], ("eta", 0.05, 0.0, 1.0))
        add("stiffness_change", [{"rate": 0.1 / duration}], ("rate", 0.1 / duration, -3 / duration, 3 / duration))
        if plasticity == "von_mises":
            add("rate_yield", [{"eta": 0.02 * eta}], ("eta", 0.03 * eta, 0.0, 3 * eta))
    return tuple(out)


def _unloads(test: MaterialTest) -> bool:
    """Return whether more than a fifth of the length of a path runs back over what was passed before, in every column."""
    e = test.path if test.mode == "simple_shear" else np.log(test.path)
    return len(e) > 2 and bool((np.ptp(e, axis=0) < 0.8 * np.abs(np.diff(e, axis=0)).sum(axis=0)).all())


def _reach(test: MaterialTest) -> float:
    """Return the largest I1 - 3 of a test at constant volume, with I1 the first invariant of the Cauchy-Green tensor."""
    if test.mode == "simple_shear":
        return max(float((test.path**2).max()), 1e-6)
    first = test.path[:, 0]
    second = {"uniaxial": first**-0.5, "equibiaxial": first, "pure_shear": np.ones_like(first), "biaxial": test.path[:, -1]}[test.mode]
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


def _recording(test: MaterialTest, noise: float | None) -> Recording:
    rows, channels = test.stress.shape
    at = np.arange(rows, dtype=np.float64) if test.time is None else test.time
    groups = np.tile(np.arange(channels), rows)
    return Recording(test.name, test.role, test.stress.reshape(-1), noise, groups, np.repeat(at, channels), "estimated")


def _noise_in(tests: MaterialTests, chain: Sequence[int], i: int) -> float | None:
    """Return the noise of test i [Pa]; for a held-out test that continues a specimen, that of its fitted part on the same machine."""
    if tests.tests[i].role == "held_out":
        found = [noise_of(tests.tests[j]) for j in chain if tests.tests[j].role == "fit"]
        if found and found[0] is not None:
            return found[0]
    return noise_of(tests.tests[i])


def noise_of(test: MaterialTest) -> float | None:
    """Estimate the standard deviation of the independent noise of a test [Pa], by local cubics along its path (`noise.high_pass`).

    Where no monotone part of the path is long enough, as in a grid of biaxial states or a curve in disorder, a curve is sorted by strain
    and states are fitted with a smooth surface. The estimate is at least 1e-4 of the largest stress, the rounding of three or four digits
    in a file. None where there are too few rows.
    """
    e = test.path if test.mode == "simple_shear" else np.log(test.path)
    pieces = []
    for rows in monotone_pieces(e):
        at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(e[rows], axis=0), axis=1))])
        pieces += [(at, channel) for channel in test.stress[rows].T]
    found = high_pass(pieces)
    if found is None and e.shape[1] == 1:
        order = np.argsort(e[:, 0], kind="stable")
        found = high_pass([(e[order, 0], channel) for channel in test.stress[order].T])
    if found is None:
        each = [one for channel in test.stress.T if (one := surface(e, channel)) is not None]
        found = math.sqrt(np.mean(np.square(each))) if each else None
    return None if found is None else max(found, 1e-4 * float(np.abs(test.stress).max()))
