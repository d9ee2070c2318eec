"""Material tests as a `Problem`: the declared law along the measured stretch or shear, and the effects that it may lack."""

import os
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch

from neuido.data.measured.material_test import CURVES, MaterialTest, MaterialTests, read_material_tests
from neuido.discrepancy.problems.declared_model import declared
from neuido.discrepancy.problems.problem import Parameter, Point, Problem, Recording
from neuido.discrepancy.problems.specimens.material_candidates import material_candidates
from neuido.discrepancy.problems.specimens.repeats import noise_of, scatter, stiffness
from neuido.errors import UserError
from neuido.physics.effects.parameters import LIBRARY, Effects
from neuido.physics.laws.classical import material
from neuido.physics.points.flow_curve import flow_stress
from neuido.physics.points.material_point import Specimen, complex_modulus, strain_along, stress_along

MOST_POINTS = 256
"""Largest number of parameter sets per batch."""
FAINT = 1e-3
"""Least predicted storage or loss modulus, relative to the smallest measured one: an elastic law has no loss, which has no logarithm."""
UNREPEATED = "No test was repeated on another specimen: how far specimens differ, often by 2 to 6 %, is not in the noise."
"""What the answer says where `repeats.scatter` has nothing to go by."""
UNLIKE = 1.25
"""Ratio of the stiffness of the model to that of the data where a loading begins, or the reverse, from which the answer says so."""


class Doubt(NamedTuple):
    """What makes a prediction doubtful."""

    words: str


class MaterialProblem(Problem):
    """Tests of one material, from a folder of the format `neuido-material-test/1` or read already.

    There is one setting, because nothing is discretised: steps of a path with a history are exact for proportional loading and subdivided
    otherwise. A held-out test that continues with the same specimen is predicted with the history of the tests before it.
    """

    def __init__(self, folder: str | os.PathLike | MaterialTests) -> None:
        tests = folder if isinstance(folder, MaterialTests) else read_material_tests(folder)
        law = tests.model["flow"] if tests.fluid else tests.model["elasticity"] | tests.model["plasticity"]
        free = tuple(declared(name, law[name]) for name in tests.free if name != "density")
        chains = tests.histories()
        repeated = scatter(tests)
        noises = [_noise_in(tests, next(chain for chain in chains if i in chain), i, repeated) for i in range(len(tests.tests))]
        candidates, fixed, excluded = material_candidates(tests)
        unit = tests.tests[0].unit
        labels: dict[str, Any] = {"kind": "material test"} | ({"excluded": excluded} if excluded else {})
        labels |= {"scatter": _is_scatter(tests, repeated)} if repeated else {"unseen": UNREPEATED}
        super().__init__(
            name=tests.name,
            measure="rmse",
            unit=unit,
            declared=free,
            nuisances=(),
            candidates=candidates,
            recordings=tuple(_recording(test, noise) for test, noise in zip(tests.tests, noises, strict=True)),
            labels=labels,
        )
        self.tests = tests
        self._chains = chains
        self._fixed = fixed
        self._partners = {p.name: p.value for c in self.candidates for p in c.parameters} | fixed | tests.effects

    def predict(self, points: Sequence[Point], recording: int, setting: int = 0) -> np.ndarray:
        n = len(self.recordings[recording].y)
        if len(points) > MOST_POINTS:
            parts = [self.predict(points[i : i + MOST_POINTS], recording) for i in range(0, len(points), MOST_POINTS)]
            return np.concatenate(parts)
        if not points:
            return np.empty((0, n))
        chain = next(chain for chain in self._chains if recording in chain)
        tests = [self.tests.tests[i] for i in chain[: chain.index(recording) + 1]]
        try:
            return self.along(points, tests)
        except UserError:  # one parameter set that the law refuses fails the whole batch
            if len(points) == 1:
                return np.full((1, n), np.nan)
            return np.concatenate([self.predict([point], recording) for point in points])

    def along(self, points: Sequence[Point], tests: Sequence[MaterialTest]) -> np.ndarray:
        """Return what the last of several tests of one specimen measures, for each parameter set."""
        last, rows = tests[-1], sum(len(test.path) for test in tests[:-1])
        path = np.concatenate([test.path for test in tests])
        time = None if last.time is None else np.concatenate([test.time for test in tests])
        if last.mode == "flow_curve":
            viscosity = np.array([float(point.get("viscosity", self.tests.model["flow"]["viscosity"])) for point in points])
            values = {name: rows.numpy() for name, rows in self._effects(points).items()}
            return np.log(flow_stress(viscosity, values, path[:, 0], time)[:, rows:])
        specimen = self._specimen(points)
        if last.mode == "oscillation":
            moduli = complex_modulus(specimen, torch.from_numpy(path[:, 0])).reshape(len(points), -1)
            least = FAINT * torch.from_numpy(last.stress).amin(dim=0).tile(len(path))
            return torch.log(torch.maximum(moduli, least)).numpy()
        options: dict[str, Any] = {"direction": last.direction, "true_stress": last.true_stress}
        options["time"] = None if time is None else torch.from_numpy(time)
        if last.control == "stress":
            given = torch.from_numpy(np.concatenate([test.stress for test in tests]))
            out = strain_along(specimen, last.mode, given, **options)
        else:
            out = stress_along(specimen, last.mode, torch.from_numpy(path), periodic=last.periodic, **options)
        return out[:, rows:].reshape(len(points), -1).numpy()

    def doubts(self, point: Point, recording: int, setting: int = 0) -> list[Doubt]:
        """Return what a test says against the stiffness of the model where a loading begins."""
        test = self.tests.tests[recording]
        if self.tests.fluid or test.mode in CURVES or test.control == "stress" or test.path.shape[1] > 1:
            return []
        poisson = float(point.get("poisson", self.tests.model["elasticity"]["poisson"]))
        shown, own = (stiffness([one], poisson) for one in (test, replace(test, stress=self.predict([point], recording).T)))
        if shown is None or own is None or 1 / UNLIKE < own / shown < UNLIKE:
            return []
        words = f"where a loading begins, it rises with a modulus of {own:.3g} Pa and the measurement with {shown:.3g} Pa"
        return [Doubt(words)]

    def _effects(self, points: Sequence[Point]) -> dict[str, torch.Tensor]:
        """Return the parameters of the effects that are in any of several parameter sets, by name, (P,) each."""
        effects = self.tests.effects | {name: 0.0 for point in points for name in point if "." in name}
        values = {}
        for effect in dict.fromkeys(name.partition(".")[0] for name in effects):
            own = [p.name for entry in LIBRARY if entry.name == effect for p in entry.parameters]
            names = [name for name in (f"{effect}.{part}" for part in own) if name in effects or name in self._partners]
            shapes = {p.name for c in self.candidates if c.name == effect for p in c.parameters} - {
                p.name for c in self.candidates if c.name == effect for p in c.size_parameters
            }
            rows = {name: _rows(points, name, self._partners.get(name, 0.0)) for name in names}
            if any(bool(row.any()) for name, row in rows.items() if name not in shapes and name not in self._fixed):
                values |= rows
        return values

    def _specimen(self, points: Sequence[Point]) -> Specimen:
        """Build a specimen with the laws and effects of several parameter sets."""
        sections = []
        for part in ("elasticity", "plasticity"):
            section = dict(self.tests.model[part])
            for p in self.declared:
                if p.name in section:
                    section[p.name] = _rows(points, p.name, p.value)
            sections.append(section)
        elasticity, plasticity = material(*sections)
        return Specimen(elasticity, plasticity, Effects.of(self._effects(points)), len(points), self.tests.incompressible)

    def shown(self, point: Point, p: Parameter) -> tuple[float, float]:
        """Return Young's modulus of a slow and of a fast test, or the viscosities at the least and the most viscous rate.

        What relaxes stiffens the law at once, and a fluid that thins has its own viscosity at rest alone.
        """
        slow, fast = super().shown(point, p)
        if self.tests.fluid and p.name == "viscosity":
            rates = ((n, test.path[:, 0]) for n, test in enumerate(self.tests.tests) if test.role == "fit")
            seen = np.concatenate([np.exp(self.predict([point], n)[0]) / rate for n, rate in rates])
            return float(seen.min()), float(seen.max())
        if p.name != "young":
            return slow, fast
        law = self._specimen([point]).law()
        if law.tables.branches is None:
            return slow, fast
        return slow, fast * (1 + float(0.5 * law.tables.branches[0, :, 0].sum() / law.shear()[0]))

    def model_after(self, values: Point, effects: Sequence[str]) -> dict[str, Any]:
        model: dict[str, Any] = {key: dict(part) if isinstance(part, dict) else part for key, part in self.tests.model.items()}
        for p in self.declared:
            for part in ("flow",) if self.tests.fluid else ("elasticity", "plasticity"):
                if p.name in model[part]:
                    model[part][p.name] = float(values.get(p.name, p.value))
        model["free"] = list(self.tests.free)
        if self.tests.incompressible:
            model["incompressible"] = True
        own = {name: value for name, value in self._fixed.items() if name.partition(".")[0] in effects}
        own |= {p.name: p.value for c in self.candidates if c.name in effects for p in c.parameters}
        own |= {name: float(value) for name, value in values.items() if name.partition(".")[0] in effects}
        if self.tests.effects or own:
            model["effects"] = self.tests.effects | own
        return model


def _rows(points: Sequence[Point], name: str, absent: float) -> torch.Tensor:
    return torch.tensor([float(point.get(name, absent)) for point in points], dtype=torch.float64)


def _recording(test: MaterialTest, noise: float | None) -> Recording:
    y = test.measured
    channels = len(y) // len(test.path)
    at = np.arange(len(test.path), dtype=np.float64) if test.time is None else test.time
    if test.mode in CURVES and test.time is None:  # rows that stand by themselves: their order in the file says nothing
        at = np.argsort(np.argsort(test.path[:, 0], kind="stable")).astype(np.float64)
    groups = np.tile(np.arange(channels), len(test.path))
    return Recording(test.name, test.role, y, noise, groups, np.repeat(at, channels), "estimated" if test.noise is None else "stated")


def _noise_in(tests: MaterialTests, chain: Sequence[int], i: int, repeated: dict[int, float]) -> float | None:
    """Return the noise of test i; for a held-out test that continues a specimen, that of its fitted part on the same machine.

    Repeats that differ by more than that say how well a test can be repeated.
    """
    own = [tests.tests[i]]
    if tests.tests[i].role == "held_out" and tests.tests[i].noise is None:
        own = [tests.tests[j] for j in chain if tests.tests[j].role == "fit"][:1] + own
    found = next((noise for noise in map(noise_of, own) if noise is not None), None)
    if tests.tests[i].noise is not None or i not in repeated:
        return found
    return max(found or 0.0, repeated[i])


def _is_scatter(tests: MaterialTests, repeated: dict[int, float]) -> bool:
    """Return whether specimens differ by more than the rows of each fitted test scatter, so that its errors are not independent."""
    fits = [i for i, test in enumerate(tests.tests) if test.role == "fit"]
    return all(tests.tests[i].noise is None and repeated.get(i, 0.0) > (noise_of(tests.tests[i]) or 0.0) for i in fits)
