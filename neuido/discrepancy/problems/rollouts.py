"""How the bodies of an experiment move under points of parameters: simulators, and launches.

A launch moves one or several recordings under one or several points each. What is seen of the motions is `body`'s.
"""

import functools
import gc
import math
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuido.data.measured.experiment import Experiment
from neuido.data.measured.experiment import Recording as Measured
from neuido.discrepancy.problems.candidates import effects_of
from neuido.discrepancy.problems.declared_model import laws_of
from neuido.discrepancy.problems.problem import Point, Problem
from neuido.discrepancy.problems.settings import AFFORDED, COARSE, CONTACT_HEIGHT, EVERY, LONGER, QUICK, SETTINGS, SOLVERS, STEADY, Setting
from neuido.errors import UserError
from neuido.physics.effects.parameters import Effects
from neuido.physics.fem.finite_elements import FiniteElements
from neuido.physics.fem.meshing import Mesh, mesh_body
from neuido.physics.mpm.simulator import Simulator
from neuido.physics.runtime.events import Event
from neuido.physics.runtime.frames import Frames
from neuido.types import ParticleState

SEGMENT = 200
"""Substeps of the piece that a GPU captures; a rollout replays it. A longer one takes longer to capture than to run."""
KEPT = {"cpu": 24, "cuda": 96}
"""Simulators that are kept: of each recording, setting, and number of parameter sets or thread. On a GPU they hold captured launches."""
SIZES = (1, 4, 12, 32, 96)
"""Parameter sets of a recording in a launch, filled up: each number of them has buffers and captured launches of its own."""

STIFFENING = ("strain_stiffening.k", "second_invariant.c", "tension_compression.r")
"""Effects that stiffen a body as it is strained, past what the inner steps of the finite elements are for."""
FINER = (1, 2, 6)
"""Times the inner steps that are tried, one after the other until the motion stays finite; the last only for what stiffens."""

LEAST_LIFT, MOST_LIFT, GAP = 0.05, 0.8, 1.0
"""Suggested cells: what the contact height moves by, at the least; how far from where it is declared it may be; and how far from the
colliders a body begins that may be lifted against them."""

Motions = tuple[Sequence[Point], int]
"""Points, and the number of the recording that moves under each of them."""


@dataclass(frozen=True, eq=False)
class BodyRollouts(Problem):
    """A problem whose data are seen of moving bodies."""

    experiment: Experiment = None  # type: ignore[assignment]
    measured: tuple[Measured, ...] = ()
    device: str = "cpu"
    # of these recordings: a copy with others (`replace`) starts with none
    _simulators: dict[Any, Simulator | FiniteElements] = field(default_factory=dict, init=False, repr=False)
    _still: dict[int, Simulator | FiniteElements] = field(default_factory=dict, init=False, repr=False)
    """By setting, one scene a recording, on the CPU: what is asked for its step alone."""
    _meshes: dict[tuple[int, float, int], Mesh] = field(default_factory=dict, init=False, repr=False)
    _lock: Any = field(default_factory=threading.RLock, init=False, repr=False)

    def effort(self, recording: int, setting: int = 0) -> float:
        """Particle-substeps; inner steps of the finite elements count as one."""
        r = self.measured[recording]
        return float(len(r.body.x) * substeps(r, r.scene.dt * EVERY[setting].dt)[1])

    def margin(self, point: Point, setting: int = 0) -> float:
        """Of the explicit step, in the recording that bears least, or of the inner steps that finite elements may take (`AFFORDED`)."""
        recordings = range(len(self.measured))
        full = [self._full(point)] * len(recordings)
        try:
            with self._lock:
                if setting not in self._still:
                    self._still[setting] = self._made(recordings, setting, 1, "cpu")
            simulator = self._still[setting]
            steps = max(substeps(self.measured[n], scene.dt)[1] for n, scene in enumerate(simulator.scenes))
            elasticity, plasticity = self.laws(full)
            ratio = simulator.step_margin(steps, elasticity, plasticity, effects=self._effects(simulator, full, recordings, ()))
        except UserError:
            return -math.inf
        return math.log(ratio)

    def refusal(self, setting: int) -> str:
        margin, line = self.margin({}, setting), self._strict(setting)
        if -math.inf < margin < 0.0:
            line += f"; it would run with discretisation.dt times {0.9 * math.exp(margin):.2g}"
            if "stiffness" in line:
                line += f", or with its moduli over its density times {0.8 * math.exp(2.0 * margin):.2g}"
        return f"the declared model cannot run: {line}"

    def _strict(self, setting: int) -> str:
        """Why the declared model's motion is not finite, in the words of its simulator."""
        for n in range(len(self.measured)):
            simulator = self._made([n], setting, 1, "cpu")
            every, steps, _ = substeps(self.measured[n], simulator.scenes[0].dt)
            full = [self._full({})]
            try:
                simulator.rollout(steps, *self.laws(full), effects=self._effects(simulator, full, [n], ()), every=every)
            except UserError as error:
                return f"recording {self.measured[n].name}: {error}"
        return "its predictions are not finite"

    def setting_name(self, setting: int) -> str:
        return EVERY[setting].name

    @property
    def duration(self) -> float:
        """Over which the knots of a force in time spread, in every recording [s]: the longest one that is fitted."""
        return max(float(r.t[-1]) for r in self.measured if r.role == "fit" and r.t is not None)

    def _moved(self, point: Point, recording: int, setting: int = 0) -> ParticleState:
        """The frames of one motion, (T, 1, P, ...)."""
        (frames,) = self._move([([point], recording)], setting)
        return frames

    def doubts(self, point: Point, recording: int, setting: int = 0) -> list[Event]:
        """What makes one motion doubtful: matter that turned inside out or collapsed, strains beyond what a law has learned."""
        noted: list[Event] = []
        self._move([([point], recording)], setting, noted=noted)
        return noted

    def _move(self, runs: Sequence[Motions], setting: int, finer: int = 0, noted: list[Event] | None = None) -> list[ParticleState]:
        """The frames of each recording under each of its points, (T, S, P, ...); of several motions those that fail are NaN.

        All move in the same launches: their frames are the same substeps (`substeps`). `finer`: which of `FINER`. `noted`: takes the
        events of the first motion.
        """
        size = most = max(len(points) for points, _ in runs)
        if self.device != "cpu":
            size = next((n for n in SIZES if n >= most), most)
        simulator = self.simulator(tuple(n for _, n in runs), setting, size)
        filled = [(point, n) for points, n in runs for point in [*points, *[points[-1]] * (size - len(points))]]
        lifts = np.array([self._lift(point, n, setting) for point, n in filled])
        full = [_against(self._full(point), lift) for (point, _), lift in zip(filled, lifts, strict=True)]
        elasticity, plasticity = self.laws(full)
        always = () if self.device == "cpu" or len(full) == 1 else [p.name for c in self.candidates for p in c.parameters]
        effects = self._effects(simulator, full, [n for _, n in runs], always)
        every, steps, exact = substeps(self.measured[runs[0][1]], simulator.scenes[0].dt)
        given = {"state": self._start(simulator, full, [n for _, n in runs], lifts), "effects": effects}
        given |= {"every": every, "segment": segment_of(steps, every)}
        elements = EVERY[setting].solver == "finite_elements"
        with torch.no_grad():
            if elements and len(full) == 1 and finer == 0:
                out = _finite(simulator, full[0], steps, elasticity, plasticity, **given)
            else:
                more = {"inner_factor": FINER[finer]} if elements else {}
                out = simulator.rollout(steps, elasticity, plasticity, nan_on_failure=len(full) > 1 or finer > 0, **given, **more)
        if noted is not None:
            noted += [event for event in out.events if event.scene == 0]
        if lifts.any():
            out = out._replace(x=out.x + _of_particles(lifts, simulator))
        moved, offsets = [], simulator.particles.offsets[::size]
        for (points, n), a, b in zip(runs, offsets[:-1], offsets[1:], strict=True):
            frames = ParticleState(*(t[:, a:b].unflatten(1, (size, -1))[:, : len(points)] for t in out))
            r = self.measured[n]
            moved.append(frames if exact else _at_times(frames, every * r.scene.dt * EVERY[setting].dt, r.t.to(out.x)))
        if elements and (len(full) > 1 or finer > 0) and finer + 1 < len(FINER):
            self._refine(runs, moved, setting, finer + 1)
        return moved

    def _refine(self, runs: Sequence[Motions], moved: Sequence[ParticleState], setting: int, finer: int) -> None:
        """Move what failed again with finer inner steps, in place; what fails with the finest that it gets stays NaN."""
        failed = []
        for (points, _), frames in zip(runs, moved, strict=True):
            broken = (~torch.isfinite(frames.x[-1]).flatten(1).all(dim=1)).tolist()
            worth = [i for i, point in enumerate(points) if broken[i] and finer < len(_finer(self._full(point)))]
            failed.append([i for i in worth if self.margin(points[i], setting) >= 0.0])
        live = [k for k, own in enumerate(failed) if own]
        if not live:
            return
        again = [([runs[k][0][i] for i in failed[k]], runs[k][1]) for k in live]
        for k, new in zip(live, self._move(again, setting, finer), strict=True):
            for t, value in zip(moved[k], new, strict=True):
                t[:, failed[k]] = value

    @functools.cached_property
    def _ups(self) -> list[np.ndarray]:
        return [_up(r) for r in self.measured]

    @functools.cached_property
    def _room(self) -> float:
        """How far the bodies that may be lifted against their colliders begin from them [m]."""
        return min((_gap(r) for r, up in zip(self.measured, self._ups, strict=True) if up.any()), default=0.0)

    @property
    def lifts(self) -> bool:
        """Whether colliders may be higher than they are declared in some recording."""
        return any(up.any() for up in self._ups)

    def others(self, setting: int) -> list[int]:
        """Of material points a finer step and grid and, where the body meets something, a lift of that, else a coarser grid.

        Of finite elements, which meet a plane where it is, other meshes, coarser and cut in another way, and the grids: what a mesh gets
        wrong no mesh knows alone.
        """
        able = [i for i, s in enumerate(SETTINGS[: self.settings]) if i != setting]
        if setting == COARSE:
            able = [i for i in able if SETTINGS[i].solver == "finite_elements"] + [self.quick(0)]
        if EVERY[setting].solver == "finite_elements":
            return [i for i in able if not EVERY[i].lift]
        if EVERY[setting] in QUICK:
            able = [0, *(i for i, s in enumerate(EVERY) if s.dt == EVERY[setting].dt and i != setting)]
        without = (lambda s: s.cells < 1.0) if self.lifts else (lambda s: s.lift > 0.0)
        return [i for i in able if EVERY[i].solver == "material_points" and not without(EVERY[i])]

    def quick(self, setting: int) -> int:
        """Material points with a longer step, finite elements with a coarser mesh."""
        if self.settings == 1 or setting not in SOLVERS:
            return setting
        if SETTINGS[setting].solver == "finite_elements":
            return COARSE
        return EVERY.index(Setting(1.0, self._longer)) if self._longer > 1.0 else setting

    @functools.cached_property
    def _longer(self) -> float:
        """Times the suggested step that leaves a margin where the model is declared, and the frames where they are."""

        def fits(factor: float) -> bool:
            return all(substeps(r, r.scene.dt)[2] == substeps(r, r.scene.dt * factor)[2] for r in self.measured)

        margin = self.margin({})
        return next((factor for factor in LONGER if math.log(factor * STEADY) <= margin and fits(factor)), 1.0)

    def recentred(self, point: Point, setting: int, amounts: Sequence[float]) -> Point:
        others, height, dx = self.others(setting), point.get(CONTACT_HEIGHT, 0.0), self.measured[0].scene.dx
        moved = -sum(EVERY[s].lift * dx * a for s, a in zip(others, amounts, strict=True))
        if abs(moved) < LEAST_LIFT * dx:
            return point
        most = min(MOST_LIFT * dx, self._room - 0.5 * GAP * dx)
        return {**point, CONTACT_HEIGHT: float(np.clip(height + moved, -MOST_LIFT * dx, most))}

    def _lift(self, point: Point, recording: int, setting: int) -> np.ndarray:
        """How much further along their normals the colliders are [m], (3,)."""
        return (point.get(CONTACT_HEIGHT, 0.0) + EVERY[setting].lift * self.measured[recording].scene.dx) * self._ups[recording]

    def _full(self, point: Point) -> dict[str, float]:
        """With what is declared beside it."""
        return {p.name: p.value for p in self.declared} | self.experiment.model.get("effects", {}) | dict(point)

    def _effects(self, simulator: Simulator, full: Sequence[Point], recordings: Sequence[int], always: Sequence[str]) -> Effects:
        """The effects of each scene; what depends on the place in the body holds for the body as the first recording holds it."""
        x, count = simulator.state.x, len(full) // len(recordings)
        offsets = simulator.particles.offsets
        turned = torch.stack([self._turn(n) for n in recordings]).to(x)
        parts = []
        for k, R in enumerate(turned):
            first, last, end = (offsets[k * count + i] for i in (0, 1, count))
            parts.append((x[first:end] - x[first:last].mean(dim=0)) @ R)
        effects = effects_of(full, torch.cat(parts), simulator.particles.scene, self.duration, always=always)
        if effects.fibre_direction is None:
            return effects
        direction = torch.as_tensor(effects.fibre_direction).to(x).expand(len(full), 3)
        return effects._replace(fibre_direction=torch.einsum("sij,sj->si", turned.repeat_interleave(count, dim=0), direction))

    def laws(self, points: Sequence[Mapping[str, float]]):
        """The declared laws of several points, a row each."""
        return laws_of(self.experiment.model, points)

    def simulator(self, recordings: Sequence[int], setting: int, count: int) -> Simulator | FiniteElements:
        """`count` copies of the scene of each recording, kept for the next call of this thread: they hold buffers."""
        key = (tuple(recordings), setting, count, threading.get_ident())
        with self._lock:
            found = self._simulators.pop(key, None)
            if found is None:
                found = self._made(recordings, setting, count, self.device)
                while len(self._simulators) >= KEPT[torch.device(self.device).type]:
                    self._simulators.pop(next(iter(self._simulators)))
            self._simulators[key] = found  # the last one used is the last one to go
        return found

    def free(self) -> None:
        """Give up the simulators that are kept, with their buffers and captured launches."""
        with self._lock:
            self._simulators.clear()
        gc.collect()
        torch.cuda.empty_cache()

    def _made(self, recordings: Sequence[int], setting: int, count: int, device: str) -> Simulator | FiniteElements:
        s = EVERY[setting]
        scenes, bodies, meshes = [], [], []
        for n in recordings:
            r = self.measured[n]
            scenes += [replace(r.scene, cells=round(r.scene.cells * s.cells), dt=r.scene.dt * s.dt)] * count
            bodies += [r.body] * count
            meshes += [self._mesh(n, s.elements, s.tetrahedra)] * count if s.solver == "finite_elements" else []
        density = self.experiment.model["density"]
        if meshes:
            elements = FiniteElements(scenes, bodies, density=density, device=device, meshes=meshes)
            declared = [self._full({})] * len(scenes)
            effects = self._effects(elements, declared, [n for n in recordings for _ in range(count)], ())
            needed = elements.max_inner_steps / elements.step_margin(1, *self.laws(declared), effects=effects)
            elements.max_inner_steps = min(math.ceil(AFFORDED * max(needed, 1.0)), elements.max_inner_steps)
            return elements
        return Simulator(scenes, bodies, density=density, device=device)

    def _mesh(self, recording: int, elements: float, tetrahedra: int) -> Mesh:
        """The body of a recording as finite elements have it; seconds of work, so that all simulators share it."""
        key = recording, elements, tetrahedra
        if key not in self._meshes:
            body = self.measured[recording].body
            wanted = None if elements == 1.0 else round(elements * len(body.x))
            self._meshes[key] = mesh_body(body.x, body.volume, elements=wanted, kind=tetrahedra)
        return self._meshes[key]

    def _start(self, simulator: Simulator, points: Sequence[Point], recordings: Sequence[int], lifts: np.ndarray) -> ParticleState:
        """The start with the velocities and spins of each point and below the lifts (S, 3), those of the first recording first."""
        count = len(points) // len(recordings)
        names = [self.measured[n].name for n in recordings for _ in range(count)]
        shift = [
            [p.get(f"{kind}_{a}:{name}", 0.0) for a in "xyz"]
            for kind in ("velocity", "spin")
            for p, name in zip(points, names, strict=True)
        ]
        state = simulator.state
        if lifts.any():
            state = state._replace(x=state.x - _of_particles(lifts, simulator))
        if not any(any(row) for row in shift):
            return state
        change = torch.tensor(shift, dtype=simulator.dtype, device=simulator.device).reshape(2, len(points), 3)
        scene, offsets = simulator.particles.scene.long(), simulator.particles.offsets
        x, v, C, F = state
        centres = torch.stack([x[offsets[s] : offsets[s + 1]].mean(dim=0) for s in range(0, len(points), count)])
        centre = centres.repeat_interleave(count, dim=0)[scene]
        w = change[1]
        skew = torch.zeros(len(points), 3, 3, dtype=x.dtype, device=x.device)
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            skew[:, k, j], skew[:, j, k] = w[:, i], -w[:, i]
        v = v + change[0][scene] + torch.einsum("pab,pb->pa", skew[scene], x - centre)
        return ParticleState(x, v, C + skew[scene], F)

    def _turn(self, recording: int) -> Tensor:
        """The rotation (3, 3) from the body of the first recording to that of another one: fibres and gradients turn with it.

        The identity where the two are not the same particles in another pose (to 1 % of the body's size).
        """
        x, y = (self.measured[n].body.x.double() for n in (0, recording))
        eye = torch.eye(3, dtype=torch.float64)
        if recording == 0 or x.shape != y.shape:
            return eye
        x, y = x - x.mean(dim=0), y - y.mean(dim=0)
        U, _, Vt = torch.linalg.svd(y.T @ x)
        R = U @ torch.diag(torch.stack([eye[0, 0], eye[0, 0], torch.linalg.det(U @ Vt)])) @ Vt
        size = float(x.norm(dim=1).max())
        straight, turned = float((x - y).abs().max()), float((x @ R.T - y).abs().max())
        return R if turned < 0.01 * size and turned < 0.5 * straight else eye


def _finer(point: Point) -> tuple[int, ...]:
    """Those of `FINER` that a full point is tried with."""
    return FINER if any(point.get(name, 0.0) > 0.0 for name in STIFFENING) else FINER[:2]


def _finite(simulator: FiniteElements, point: Point, *args: Any, **given: Any) -> Frames:
    """A rollout of one scene, with finer inner steps where the motion is not finite.

    Raises:
        UserError: As the rollout, with the finest of them.
    """
    *others, finest = _finer(point)
    for finer in others:
        try:
            return simulator.rollout(*args, **given, inner_factor=finer)
        except UserError:
            continue
    return simulator.rollout(*args, **given, inner_factor=finest)


def _up(r: Measured) -> np.ndarray:
    """Along the colliders' normals, (3,): where those of a recording go when they are higher.

    Zero where there are none, where the body begins on one, and where it is clamped: it must not move along what holds it.
    """
    free = r.scene.colliders and not r.scene.clamps and _gap(r) > GAP * r.scene.dx
    return np.unique(_normals(r), axis=0).sum(axis=0) if free else np.zeros(3)


def _normals(r: Measured) -> list[np.ndarray]:
    """Of the colliders of a recording, of length one."""
    return [np.array(p.normal) / math.hypot(*p.normal) for p in r.scene.colliders]


def _gap(r: Measured) -> float:
    """How far the body of a recording begins from the colliders [m]."""
    x = r.body.x.double().numpy()
    gaps = (float(((x - np.array(p.point)) @ n).min()) for p, n in zip(r.scene.colliders, _normals(r), strict=True))
    return min(gaps, default=math.inf)


def _against(point: dict[str, float], lift: np.ndarray) -> dict[str, float]:
    """A full point for a body that starts below a lift (3,) [m]: what has a place in space is below it too."""
    own = {f"position_force.{a}": d for a, d in zip("xyz", lift, strict=True)}
    return {name: value - own.get(name, 0.0) for name, value in point.items()} if lift.any() else point


def substeps(r: Measured, dt: float) -> tuple[int, int, bool]:
    """Substeps between kept frames, substeps in all, and whether the kept frames are the recorded ones."""
    t = r.t.double().numpy()
    every = round(r.frame_interval / dt)
    if every >= 1 and np.allclose(t, np.arange(len(t)) * every * dt, rtol=0.0, atol=1e-3 * r.frame_interval):
        return every, every * (len(t) - 1), True
    every = max(1, round(float(np.diff(t).min()) / dt / 6))
    return every, every * int(np.ceil(t[-1] / (every * dt) + 1e-9)), False


def segment_of(steps: int, every: int) -> int:
    """Substeps of a piece of a rollout: a divisor of `steps` and a multiple of `every`, of `SEGMENT` at the most where there is one."""
    frames = steps // every
    return every * max(n for n in range(1, frames + 1) if frames % n == 0 and (n == 1 or n * every <= SEGMENT))


def _of_particles(lifts: np.ndarray, simulator: Simulator | FiniteElements) -> Tensor:
    """The lift (3,) of each scene at each of its particles, (P, 3)."""
    return torch.from_numpy(lifts).to(simulator.state.x)[simulator.particles.scene.long()]


def _at_times(frames: ParticleState, step: float, t: Tensor) -> ParticleState:
    """Frames (K, S, P, ...) that are `step` apart at other times: cubic Hermite interpolation of x, linear of the rest."""
    x, v, C, F = frames
    k = (t / step).floor().long().clamp(max=len(x) - 2)
    u = (t / step - k)[:, None, None, None]
    x0, x1, v0, v1 = x[k], x[k + 1], v[k] * step, v[k + 1] * step
    place = (1 + 2 * u) * (1 - u) ** 2 * x0 + u * (1 - u) ** 2 * v0 + u**2 * (3 - 2 * u) * x1 + u**2 * (u - 1) * v1
    w = u[..., None]
    return ParticleState(place, ((1 - u) * v0 + u * v1) / step, (1 - w) * C[k] + w * C[k + 1], (1 - w) * F[k] + w * F[k + 1])
