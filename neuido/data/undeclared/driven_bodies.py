"""Generate bars that are pulled by a clamp, with forces at both ends, and an undeclared effect: `Case.measured` = driven."""

import functools
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neuido.data.measured.clamps import Clamp, MeasuredForce
from neuido.data.measured.experiment import Experiment, Recording, read_experiment, write_experiment
from neuido.data.undeclared.case import Case
from neuido.data.undeclared.random_effects import (
    ELASTIC,
    MIN_SEPARATION,
    Redraw,
    Scales,
    draw_effect,
    rms,
    rounded_to_4,
    scale_to_separation,
    truth_entry,
)
from neuido.errors import UserError
from neuido.physics.effects.parameters import Effects
from neuido.physics.laws.classical import material
from neuido.physics.mpm.simulator import Simulator
from neuido.types import Body, Box, Keyframes, Scene

DRIVEN = ("viscosity_shear", "maxwell", "hysteresis", "strain_stiffening", "drag_linear", "stiffness_change")
"""Effects that a pull at one end shows."""
LENGTH, SIDE, CELL = 0.27, 0.045, 0.0225
"""Length and width of the bar, and a cell of the suggested grid [m]."""
FORCE_NOISE, SAMPLES = 0.005, 4
"""Noise of a force relative to the largest one, and its samples in a frame interval."""


def driven_case(
    rng: np.random.Generator, case: Case, name: str, device: str, advance: Callable[[int], Any]
) -> tuple[Callable[[Path], None], dict[str, Any]]:
    """Draw a pulled bar; return a function that writes its folder, and the content of its key.

    Raises:
        Redraw: The drawn values make no usable case.
        UserError: The kind of effect is none of a pulled bar.
    """
    made = DrivenBar(rng, case, device, advance)
    made.size_effect(case.separation)
    return functools.partial(_write, made.experiment(name)), made.truth()


class DrivenBar:
    """Random choices of one pulled bar, in a fixed order, and its simulations."""

    def __init__(self, rng: np.random.Generator, case: Case, device: str, advance: Callable[[int], Any]) -> None:
        self.rng, self.device, self.advance = rng, device, advance
        if case.kind not in (None, "none", *DRIVEN):
            raise UserError(f"kind = {case.kind!r}: a pulled bar may have none, {', '.join(DRIVEN)}")
        drawn = "none" if rng.random() < 1 / 3 else str(rng.choice(DRIVEN))
        self.kind = drawn if case.kind is None else case.kind
        self.young = float(f"{np.exp(rng.uniform(np.log(2e4), np.log(1.5e5))):.3g}")
        self.law = {"law": "neo_hookean", "young": self.young, "poisson": round(rng.uniform(0.2, 0.4), 3)}
        self.density = 1000.0
        self.noise = float(rng.choice([1e-4, 2e-4]))
        self.seconds = case.seconds or 0.3
        self.interval = 0.01
        self.scene = Scene((0.0, 0.0, 0.0), (0.18, 0.45, 0.18), 20, 2.5e-4, (0.0, -9.8, 0.0), (), None)
        self.body = _bar()
        paths = [self._path() for _ in range(2)]
        y = self.body.x[:, 1]
        low, high = float(y.min()), float(y.max())
        ends = [((0.0, 0.0, 0.0), (0.18, low + CELL, 0.18)), ((0.0, high - CELL, 0.0), (0.18, 0.45, 0.18))]
        self.clamps = [(Clamp("lower", Box(*ends[0])), Clamp("upper", Box(*ends[1]), path)) for path in paths]
        free = ((y > low + CELL) & (y < high - CELL)).nonzero()[:, 0].numpy()
        self.points = np.sort(rng.permutation(free)[:60])
        self.effect = None
        self.plain = [self._run(n, {}) for n in range(2)]

    def _path(self) -> Keyframes:
        """Draw a pull with a swing on it, at rest at t = 0, as a table of poses."""
        t = np.arange(0.0, self.seconds + 2 * self.interval, self.interval)
        rise = np.clip(t / self.rng.uniform(0.05, 0.15), 0.0, 1.0)
        pull = self.rng.uniform(0.03, 0.06) * rise**3 * (10 - 15 * rise + 6 * rise**2)
        swing = self.rng.uniform(0.005, 0.012) * rise**2 * np.sin(2 * np.pi * self.rng.uniform(6.0, 14.0) * t)
        places = np.stack([0.3 * swing, pull + swing, 0 * t], 1)
        return Keyframes(tuple(t.tolist()), tuple(map(tuple, places.tolist())), smooth=True)  # type: ignore[arg-type]

    def _run(self, recording: int, values: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray]:
        """Simulate a recording; return the points [m], (T, N, 3), and the forces of the clamps between samples [N], (m, 2, 3)."""
        recorded = Recording("", "fit", self.scene, self.interval, clamps=self.clamps[recording])
        try:
            simulator = Simulator([recorded.held_scene], [self.body], density=self.density, device=self.device)
            elasticity, plasticity = material(self.law, {"law": ELASTIC})
            effects = Effects.of(dict(values), x=simulator.state.x, scene=simulator.particles.scene)
            every = round(self.interval / SAMPLES / self.scene.dt)
            steps = every * SAMPLES * round(self.seconds / self.interval)
            with torch.no_grad():
                frames = simulator.rollout(steps, elasticity, plasticity, effects=effects, every=every)
        except UserError as error:
            raise Redraw(str(error)) from error
        finally:
            self.advance(1)
        return frames.x[::SAMPLES, self.points].double().cpu().numpy(), -frames.forces[1:].cpu().numpy()

    def size_effect(self, separation: float | None) -> None:
        """Draw the effect; scale it to move points and forces by `separation` times their noise, or by a random multiple if None."""
        self.force_noise = float(f"{FORCE_NOISE * max(np.abs(force).max() for _, force in self.plain):.3g}")
        self.true, self.separations = self.plain, []
        if self.kind == "none":
            return
        x = self.body.x.numpy()
        extent = np.ptp(x, axis=0)
        speed = max(float(np.abs(np.diff(own[0], axis=0)).max()) / self.interval for own in self.plain)
        scales = Scales(self.young, self.density, LENGTH, 0.5 * extent, x.mean(0), self.seconds, speed, self.scene.dt, CELL, 0.0)
        ratio = separation or float(np.exp(self.rng.uniform(np.log(20.0), np.log(60.0))))
        drawn = draw_effect(self.kind, self.rng, scales)
        self.effect = scale_to_separation(drawn, ratio, lambda one: self._apart(self._run(0, one.values), 0), MIN_SEPARATION).rounded()
        self.true = [self._run(n, self.effect.values) for n in range(2)]
        self.separations = [self._apart(own, n) for n, own in enumerate(self.true)]

    def _apart(self, moved: tuple[np.ndarray, np.ndarray], recording: int) -> float:
        """Return how far points and forces are from those without the effect, in standard deviations of their noise."""
        plain = self.plain[recording]
        return max(rms(moved[0] - plain[0]) / self.noise, rms(moved[1] - plain[1]) / self.force_noise)

    def truth(self) -> dict[str, Any]:
        """Return the content of the key."""
        rows = [{"name": f"pull{n + 1}", "role": ("fit", "held_out")[n], "separation_over_noise": rounded_to_4(own)}
                for n, own in enumerate(self.separations)]  # fmt: skip
        return {
            "undeclared": [] if self.effect is None else [truth_entry(self.effect, free=("young",))],
            "measured": "driven",
            "material": {"elasticity": self.law["law"], **{k: v for k, v in self.law.items() if k != "law"}, "density": self.density},
            "simulated_with": f"a material point method, {self.scene.cells} cells, substep {self.scene.dt:g} s",
            "solver": "same",
            "noise": self.noise,
            "force_noise": self.force_noise,
            "recordings": rows,
        }

    def experiment(self, name: str) -> Experiment:
        """Return the experiment, with noise."""
        times = torch.arange(len(self.true[0][0]), dtype=torch.float64) * self.interval
        step = self.interval / SAMPLES
        at = (np.arange(len(self.true[0][1])) + 0.5) * step
        recordings = []
        for n, (x, force) in enumerate(self.true):
            clamps = []
            for i, clamp in enumerate(self.clamps[n]):
                values = force[:, i] + self.force_noise * self.rng.normal(size=force[:, i].shape)
                values[:, 2] = np.nan  # a load cell of two axes
                clamps.append(replace(clamp, force=MeasuredForce(at, values, self.force_noise)))
            seen = x + self.noise * self.rng.normal(size=x.shape)
            recordings.append(
                Recording(
                    f"pull{n + 1}", ("fit", "held_out")[n], self.scene, self.interval, self.noise, torch.from_numpy(seen).float(), times,
                    self.body, torch.from_numpy(self.points), clamps=tuple(clamps),
                )
            )  # fmt: skip
        declared = float(f"{self.young * self.rng.uniform(0.8, 1.25):.3g}")
        model = {"density": self.density, "elasticity": self.law | {"young": declared}, "plasticity": {"law": ELASTIC}}
        return Experiment(name, Path("."), self.scene, model, ("young",), tuple(recordings))


def _bar() -> Body:
    """Return an upright bar, two particles a cell along each axis."""
    axes = [torch.linspace(CELL / 4, side - CELL / 4, round(2 * side / CELL)) for side in (SIDE, LENGTH, SIDE)]
    x = torch.cartesian_prod(*axes) + torch.tensor([0.0675, 0.05, 0.0675])
    return Body(x, torch.zeros_like(x), torch.full((len(x),), LENGTH * SIDE**2 / len(x)))


def _write(experiment: Experiment, folder: Path) -> None:
    write_experiment(experiment, folder)
    read_experiment(folder)  # raises if the written files cannot be read
