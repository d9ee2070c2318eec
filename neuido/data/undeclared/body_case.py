"""Generate experiments with an undeclared effect: draw body and effect, scale the effect, simulate two recordings."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neuido.data.measured.experiment import Experiment, Recording, read_experiment, write_experiment
from neuido.data.undeclared import random_bodies as bodies
from neuido.data.undeclared.case import Case
from neuido.data.undeclared.instruments import Markers, max_speed, measured_positions, nuisance_vector, wrong_nuisances
from neuido.data.undeclared.motion import Motion, Solver, simulate_motion
from neuido.data.undeclared.random_effects import (
    ANY,
    ELASTIC,
    GRAINS,
    KINDS,
    MAX_SEPARATION,
    MIN_SEPARATION,
    OUTSIDE,
    OVER_FLOOR,
    PLASTIC,
    SOLID,
    Drawn,
    Kind,
    Redraw,
    Scales,
    draw_effect,
    rms,
    rounded_to_4,
    scale_to_separation,
    truth_entry,
)
from neuido.errors import UserError
from neuido.types import Body

SOLVERS = ("same", "finer", "elements")
MARGIN = 0.03
"""Smallest distance of particles from the faces of the domain [m]."""
SLOW_LOSS = ("drag_linear", "viscosity_shear", "restitution")
"""Kinds of dissipation that a coarse substep imitates; half of these cases suggest half the substep."""


def draw_kinds(rng: np.random.Generator, case: Case) -> tuple[str, ...]:
    """Draw the effects of a case: none, one or two of the library, or one outside the library."""
    if case.kind is not None:
        return () if case.kind == "none" else tuple(case.kind.split("+"))
    u = rng.random()
    if u < 1 / 3 or case.nuisances:
        return ()
    if u < 0.47:
        return (str(rng.choice(list(OUTSIDE))),)
    first = str(rng.choice(list(KINDS)))
    if u > 0.87:
        fits = [k for k, v in KINDS.items() if v.stage != KINDS[first].stage and set(v.models) & set(KINDS[first].models)]
        return first, str(rng.choice(fits))
    return (first,)


def body_case(
    rng: np.random.Generator, case: Case, name: str, device: str, advance: Callable[[int], Any]
) -> tuple[Callable[[Path], None], dict[str, Any]]:
    """Draw an experiment; return a function that writes its folder, and the content of its key.

    Raises:
        Redraw: The drawn values make no usable case.
        UserError: The options of `case` do not suit each other.
    """
    made = BodyCase(rng, case, device, advance)
    made.size_effects(case.separation)
    made.record(case.nuisances)
    truth = made.truth()
    return made.writer(name), truth


class BodyCase:
    """Random choices of one experiment, in a fixed order, and its simulations.

    Args:
        rng: Random generator.
        case: Fixed properties of the case.
        device: auto, cpu or cuda.
        advance: Called with 1 after each simulation.
    """

    def __init__(self, rng: np.random.Generator, case: Case, device: str, advance: Callable[[int], Any]) -> None:
        self.rng, self.device, self.advance = rng, device, advance
        self.kinds = draw_kinds(rng, case)
        entries = [KINDS[k] if k in KINDS else OUTSIDE[k] for k in self.kinds]
        chosen, models = self._solver(case, entries)
        weights = np.array([{ELASTIC: 5.0, PLASTIC: 1.5}.get(m, 1.0) for m in models])
        hard = any(e.stage == "material" or e.grid for e in entries)
        self.material = bodies.draw_material(rng, str(rng.choice(models, p=weights / weights.sum())), soft=hard)
        self.scene = bodies.draw_scene(rng, self.material, slippery="stick" in self.kinds)
        if "viscosity_bulk" in self.kinds or (set(self.kinds) & set(SLOW_LOSS) and rng.random() < 0.5):
            self.scene = replace(self.scene, dt=0.5 * self.scene.dt)
        self.suggested = Solver("same", self.scene.cells, self.scene.dt)
        self.solver = self.suggested
        if chosen == "finer":
            self.solver = Solver(chosen, int(rng.integers(36, 45)), self.scene.dt / 2)
        elif chosen == "elements":
            self.solver = self.suggested._replace(name=chosen, tetrahedra=int(rng.choice([5, 6])), density=float(rng.uniform(0.7, 1.6)))
        self.interval = 0.008 if self.material.plasticity["law"] == GRAINS else 0.01
        frames = round((case.seconds or rng.uniform(0.4, 0.6)) / self.interval)
        self.at = np.arange(frames + 1) * self.interval
        self.seconds = frames * self.interval
        self.noise = float(rng.choice([8e-4, 1e-3] if chosen == "elements" else [5e-4, 6e-4, 8e-4, 1e-3]))
        if "restitution" in self.kinds:
            self.noise = 1e-4  # a floor that takes all of a rebound's speed moves an elastic body by two or three millimetres
        _, self.points, self.volume = bodies.draw_body(rng, case.particles or int(rng.integers(1500, 2900)))
        turned = not any(e.directed for e in entries) and rng.random() < 0.6
        floor = self.scene.colliders[0].point[1]
        self.launches = bodies.draw_launches(
            rng,
            self.points,
            floor,
            self.seconds,
            turned=turned,
            sliding=bool(set(self.kinds) & {"friction", "stick"}),
            hard=hard,
            spinning="spin_decay" in self.kinds,
        )
        self.declared = [bodies.launched_body(self.points, self.volume, launch) for launch in self.launches]
        self.markers = Markers(rng, self.points, min(int(rng.integers(300, 451)), len(self.points)))
        self.markers.fix(self.launches, self.points)
        self.effects: list[Drawn] = []

    def _solver(self, case: Case, entries: Sequence[Kind]) -> tuple[str, list[str]]:
        """Draw a solver; return it and the declared plasticities that suit it and the effects."""
        models = [m for m in ANY if all(m in e.models for e in entries)]
        if not models:
            raise UserError(f"case.kind = {'+'.join(self.kinds)}: no plasticity suits both effects: give another pair")
        chosen = case.solver or str(self.rng.choice(SOLVERS))
        if chosen == "elements":
            solid = [m for m in models if m in SOLID]
            if not any(e.grid for e in entries) and solid:
                return chosen, solid
            if case.solver is not None and case.kind is not None:
                raise UserError(f"case.solver = elements does not support {'+'.join(self.kinds)}: give same or finer")
            if case.solver is not None:
                raise Redraw(f"elements do not suit {'+'.join(self.kinds)}")
            chosen = "finer"
        if len(models) == len(ANY) and self.rng.random() < 0.5:
            models = [ELASTIC]
        return chosen, models

    @property
    def values(self) -> dict[str, float]:
        """Parameters of all effects by flat names."""
        return {key: value for one in self.effects for key, value in one.values.items()}

    def run(self, solver: Solver, values: Mapping[str, float], started: list[Body] | None = None, extra: float = 0.0) -> Motion:
        """Simulate all recordings with effects `values`, from the launches or from the bodies `started`.

        Args:
            solver: The solver.
            values: Parameters of the effects by flat names.
            started: Initial bodies; None: those of the launches.
            extra: Time beyond the duration of the recordings [s].

        Raises:
            Redraw: The simulation fails, or the body leaves the domain.
        """
        law = {"density": self.material.density, "elasticity": self.material.elasticity, "plasticity": self.material.plasticity}
        started = self.declared if started is None else started
        seconds = self.seconds + extra
        try:
            moved = simulate_motion(
                solver, self.scene, started, law, values, seconds=seconds, interval=self.interval / 2, device=self.device
            )
        except UserError as error:
            raise Redraw(str(error)) from error
        finally:
            self.advance(1)
        if not (moved.x.min() > MARGIN and moved.x.max() < 1 - MARGIN):
            raise Redraw("the body leaves the domain")
        return moved

    def marker_positions(self, motion: Motion) -> np.ndarray:
        """Return the positions of the markers at the frames [m], (S, T, N, 3)."""
        return np.stack([self.markers.follow(motion.at(self.at, i)[0], i) for i in range(len(motion.x))])

    def size_effects(self, separation: float | None) -> None:
        """Draw the effects; scale each to move the markers by `separation` times the noise, or by a random multiple if None."""
        self.plain = self.marker_positions(self.run(self.suggested, {}))
        self.bare = self.plain if self.solver == self.suggested else self.marker_positions(self.run(self.solver, {}))
        floor = rms(self.bare[0] - self.plain[0])
        extent = np.ptp(self.points, axis=0)
        scales = Scales(
            young=self.material.elasticity["young"],
            density=self.material.density,
            length=float(extent.max()),
            half=0.5 * extent,
            centre=self.launches[0].centre,
            duration=self.seconds,
            speed=max(max_speed(x, self.interval) for x in self.plain),
            dt=self.scene.dt,
            dx=self.scene.dx,
            yield_stress=float(self.material.plasticity.get("yield_stress", 0.0)),
        )

        def moved_by(one: Drawn) -> float:
            return rms(self.marker_positions(self.run(self.suggested, one.values, self.declared[:1]))[0] - self.plain[0])

        smallest = 1.2 * max(MIN_SEPARATION * self.noise, OVER_FLOOR * floor)
        for kind in self.kinds:
            ratio = separation or float(np.exp(self.rng.uniform(np.log(20.0), np.log(110.0))))
            target = min(max(ratio * self.noise, 1.5 * OVER_FLOOR * floor), 0.9 * MAX_SEPARATION * self.noise)
            self.effects.append(scale_to_separation(draw_effect(kind, self.rng, scales), target, moved_by, smallest).rounded())

    def record(self, nuisances: bool | None) -> None:
        """Simulate the recordings, and the references without each effect and with the suggested solver.

        Raises:
            Redraw: An effect moves the markers too little or too much.
        """
        wanted = nuisances if nuisances is not None else not self.kinds and self.rng.random() < 0.5
        self.off = wrong_nuisances(self.rng, self.plain, self.interval, float(np.ptp(self.points, axis=0).max())) if wanted else []
        started = [
            bodies.launched_body(
                self.points, self.volume, launch, velocity=nuisance_vector(own, "velocity"), spin=nuisance_vector(own, "spin")
            )
            for launch, own in zip(self.launches, self.off)
        ]
        extra = 3 * self.interval  # a fast clock records beyond the end
        true = self.run(self.solver, self.values, started or None, extra)
        self.events = [[event.words for event in true.events if event.scene == i] for i in range(2)]
        same = true if self.solver == self.suggested else self.run(self.suggested, self.values, started or None, extra)
        self.recorded, reference = (
            [measured_positions(motion, self.markers, i, self.at, self.off[i] if self.off else {}) for i in range(2)]
            for motion in (true, same)
        )
        self.separations = [math.inf, math.inf]
        for one in self.effects:
            rest = {key: value for key, value in self.values.items() if key not in one.values}
            without = self.marker_positions(self.run(self.solver, rest)) if rest else self.bare
            self.separations = [min(a, rms(x - y)) for a, x, y in zip(self.separations, self.recorded, without)]
        self.reference = [rms(x - y) for x, y in zip(self.recorded, reference)]
        if self.effects and not (
            MIN_SEPARATION <= self.separations[0] / self.noise <= MAX_SEPARATION and self.separations[1] >= MIN_SEPARATION * self.noise
        ):
            raise Redraw(f"the effect moves the points by {self.separations[0]:.2g} m and {self.separations[1]:.2g} m")
        if self.effects and self.separations[0] < OVER_FLOOR * self.reference[0]:
            raise Redraw("the effect moves the points by little more than the solvers differ")

    def truth(self) -> dict[str, Any]:
        """Return the content of the key."""
        rows = []
        for i in range(2):
            row: dict[str, Any] = {"name": f"take{i + 1}", "role": ("fit", "held_out")[i]}
            if self.effects:
                row["separation_rms_m"] = rounded_to_4(self.separations[i])
                row["separation_over_noise"] = rounded_to_4(self.separations[i] / self.noise)
            row["reference_rms_m"] = rounded_to_4(self.reference[i])
            row["best_achievable_rms_m"] = rounded_to_4(math.hypot(self.noise, self.reference[i]))
            if self.events[i]:
                row["events"] = self.events[i]
            rows.append(row)
        material = self.material
        figures = {k: v for part in (material.elasticity, material.plasticity) for k, v in part.items() if k != "law"}
        laws = {"elasticity": material.elasticity["law"], "plasticity": material.plasticity["law"]}
        truth = {
            "undeclared": [truth_entry(one, free=material.free) for one in self.effects],
            "material": {**laws, **figures, "density": material.density},
            "started_from": material.declared,
            "simulated_with": self.solver.describe(),
            "solver": self.solver.name,
            "noise": self.noise,
            "recordings": rows,
        }
        return truth | ({"nuisances": {row["name"]: own for row, own in zip(rows, self.off)}} if self.off else {})

    def writer(self, name: str) -> Callable[[Path], None]:
        """Return a function that writes the experiment, with noise and gaps, to a folder and reads it back."""
        gaps = self.rng.random() < 0.3
        recordings = []
        for i, x in enumerate(self.recorded):
            x = x + self.rng.normal(size=x.shape) * self.noise
            if gaps:
                x[self.rng.random(x.shape[:2]) < 0.04] = np.nan
            recordings.append(
                Recording(
                    name=f"take{i + 1}",
                    role=("fit", "held_out")[i],
                    scene=self.scene,
                    frame_interval=self.interval,
                    noise=self.noise,
                    x=torch.from_numpy(x).float(),
                    t=torch.from_numpy(self.at),
                    body=self.declared[i],
                    **self.markers.named(i),
                )
            )
        experiment = Experiment(name, Path("."), self.scene, self.material.model(), self.material.free, tuple(recordings))

        def write_folder(folder: Path) -> None:
            write_experiment(experiment, folder)
            read_experiment(folder)  # raises if the written files cannot be read

        return write_folder
