"""Simulation of the bodies of an experiment for sets of parameters.

One launch simulates one or several recordings with one or several parameter sets each. `body` and `video` compare the motions with data.
"""

import functools
import gc
import math
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuido.data.measured.experiment import Experiment
from neuido.data.measured.experiment import Recording as Measured
from neuido.discrepancy.problems import body_launches, settings
from neuido.discrepancy.problems.body_launches import Pushes, at_times, frames_until, pushes_of, segment_of, standing_still, substeps
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

KEPT = {"cpu": 24, "cuda": 96}
"""Largest number of simulators in memory. On a GPU each holds captured launches."""
KNOWN = 10_000
"""Largest number of stability limits in memory."""
SIZES = (1, 4, 12, 32, 96)
"""Numbers of parameter sets per recording in a launch. Others are filled up, since each number needs own buffers and captured launches."""

STIFFENING = ("strain_stiffening.k", "second_invariant.c", "tension_compression.r")
"""Parameters of effects that stiffen a strained body, so that the usual inner steps of finite elements may be too long."""
FINER = (1, 2, 6)
"""Factors on the number of inner steps of finite elements, tried in turn until the motion stays finite; the last only with `STIFFENING`."""

LEAST_LIFT, MOST_LIFT, GAP = 0.05, 0.8, 1.0
"""Contact height [suggested cells]: its least change, its largest distance from the declared height, and the least gap at the start between
body and colliders with which it may change."""

Motions = tuple[Sequence[Point], int]
"""Parameter sets, and the number of the recording that is simulated with each of them."""


@dataclass(frozen=True, eq=False)
class BodyRollouts(Problem):
    """A problem with simulated bodies; subclasses compare their motions with the data."""

    experiment: Experiment = None  # type: ignore[assignment]
    measured: tuple[Measured, ...] = ()
    device: str = "cpu"
    # these depend on the recordings: a copy with other recordings (`replace`) starts without them
    _simulators: dict[Any, Simulator | FiniteElements] = field(default_factory=dict, init=False, repr=False)
    _still: dict[int, Simulator | FiniteElements] = field(default_factory=dict, init=False, repr=False)
    """Simulators on the CPU by setting, with a scene per recording; they only compute stability limits."""
    _meshes: dict[tuple[int, float, int], Mesh] = field(default_factory=dict, init=False, repr=False)
    _lock: Any = field(default_factory=threading.RLock, init=False, repr=False)

    def effort(self, recording: int, setting: int = 0) -> float:
        """Return the cost of a prediction in particle-substeps; the inner steps of finite elements are not counted."""
        r = self.measured[recording]
        return float(len(r.body.x) * substeps(r, r.scene.dt * EVERY[setting].dt, EVERY[setting].share)[1])

    def margin(self, point: Point, setting: int = 0) -> float:
        """Return `Problem.margin`, the least of all recordings; of finite elements that of the inner steps they may take (`AFFORDED`)."""
        return self._margins(tuple(sorted(point.items())), settings.whole(setting))

    @functools.cached_property
    def _margins(self) -> Callable[[tuple[tuple[str, float], ...], int], float]:
        return functools.lru_cache(KNOWN)(lambda items, setting: self._margin(dict(items), setting))

    def inner_steps(self, point: Point, setting: int) -> int:
        """Return the inner steps of finite elements for a parameter set, the same in all recordings; 0 if it may not take enough."""
        margin = self.margin(point, setting)
        return body_launches.inner_steps(self._still[settings.whole(setting)].max_inner_steps / math.exp(margin)) if margin >= 0.0 else 0

    def _margin(self, point: Point, setting: int) -> float:
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
        margin, line = self.margin({}, setting), self._failure_message(setting)
        if -math.inf < margin < 0.0:
            line += f"; it would run with discretisation.dt times {0.9 * math.exp(margin):.2g}"
            if "stiffness" in line:
                line += f", or with its moduli over its density times {0.8 * math.exp(2.0 * margin):.2g}"
        return f"the declared model cannot run: {line}"

    def _failure_message(self, setting: int) -> str:
        """Simulate the declared model, and return the simulator's message why the motion is not finite."""
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
        """Time [s] over which the knots of a time-dependent force are spread: that of the longest fitted recording."""
        return max(float(r.t[-1]) for r in self.measured if r.role == "fit" and r.t is not None)

    def _moved(self, point: Point, recording: int, setting: int = 0) -> ParticleState:
        """Simulate one recording with one parameter set, and return its frames, (T, 1, P, ...)."""
        (frames,) = self._move([([point], recording)], setting)
        return frames

    def doubts(self, point: Point, recording: int, setting: int = 0) -> list[Event]:
        """Return the events that make a motion doubtful: matter turned inside out or collapsed, strains beyond the training of a law."""
        noted: list[Event] = []
        self._move([([point], recording)], setting, noted=noted)
        return noted

    def _move(
        self, runs: Sequence[Motions], setting: int, finer: int = 0, noted: list[Event] | None = None, pushed: list[Pushes] | None = None
    ) -> list[ParticleState]:
        """Simulate recordings with several parameter sets each in one launch.

        Args:
            runs: Parameter sets and recording of each run. All recordings have their frames at the same substeps (`substeps`).
            setting: Number of the setting.
            finer: Place in `FINER` of the factor on the inner steps.
            noted: List to which the events of the first motion are added.
            pushed: List to which what the clamps give to the bodies of each run is added.

        Returns:
            Frames of each run, (T, S, P, ...) for S parameter sets. A motion that fails is NaN.

        Raises:
            UserError: There is one motion alone, and it fails.
        """
        size = most = max(len(points) for points, _ in runs)
        if self.device != "cpu":
            size = next((n for n in SIZES if n >= most), most)
        simulator = self.simulator(tuple(n for _, n in runs), setting, size)
        filled = [(point, n) for points, n in runs for point in [*points, *[points[-1]] * (size - len(points))]]
        lifts = np.array([self._lift(point, n, setting) for point, n in filled])
        full = [_for_lowered_body(self._full(point), lift) for (point, _), lift in zip(filled, lifts, strict=True)]
        elasticity, plasticity = self.laws(full)
        always = () if self.device == "cpu" or len(full) == 1 else body_launches.names(self.candidates, max(map(body_launches.stage, full)))
        effects = self._effects(simulator, full, [n for _, n in runs], always)
        share, first = EVERY[setting].share, self.measured[runs[0][1]]
        every, steps, exact = substeps(first, simulator.scenes[0].dt, share)
        segment = segment_of(steps if self.device == "cpu" else substeps(first, simulator.scenes[0].dt)[1], every)
        steps = segment * math.ceil(steps / segment)  # on a GPU, what is captured for whole motions serves early ones too
        given = {"state": self._start(simulator, full, [n for _, n in runs], lifts), "effects": effects}
        given |= {"every": every, "segment": segment}
        given |= body_launches.scaled_paths(simulator, steps, [(point, self.measured[n].name) for point, n in filled])
        elements = EVERY[setting].solver == "finite_elements"
        if elements and len(inner := {self.inner_steps(point, setting) for points, _ in runs for point in points}) == 1 and any(inner):
            given["inner"] = inner.pop()
        with torch.no_grad():
            if elements and len(full) == 1 and finer == 0:
                out = _rollout_until_finite(simulator, full[0], steps, elasticity, plasticity, **given)
            else:
                more = {"inner_factor": FINER[finer]} if elements else {}
                out = simulator.rollout(steps, elasticity, plasticity, nan_on_failure=len(full) > 1 or finer > 0, **given, **more)
        if pushed is not None:
            pushed += [
                pushes_of(out, range(k * size, k * size + len(points)), len(self.measured[n].clamps)) for k, (points, n) in enumerate(runs)
            ]
        if noted is not None:
            noted += [event for event in out.events if event.scene == 0]
        if lifts.any():
            out = out._replace(x=out.x + _of_particles(lifts, simulator))
        moved, offsets = [], simulator.particles.offsets[::size]
        for (points, n), a, b in zip(runs, offsets[:-1], offsets[1:], strict=True):
            frames = ParticleState(*(t[:, a:b].unflatten(1, (size, -1))[:, : len(points)] for t in out))
            r = self.measured[n]
            if not exact:
                frames = at_times(frames, every * r.scene.dt * EVERY[setting].dt, r.t[: frames_until(r, share)].to(out.x))
            moved.append(standing_still(frames, len(r.t)))
        if elements and (len(full) > 1 or finer > 0) and finer + 1 < len(FINER):
            self._refine(runs, moved, setting, finer + 1)
        return moved

    def _refine(self, runs: Sequence[Motions], moved: Sequence[ParticleState], setting: int, finer: int) -> None:
        """Simulate failed motions again with more inner steps, and replace them in `moved`; those that fail again stay NaN."""
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
        """Least distance at the start between colliders and body, of the recordings whose contact height may change [m]."""
        return min((_gap(r) for r, up in zip(self.measured, self._ups, strict=True) if up.any()), default=0.0)

    @property
    def lifts(self) -> bool:
        """Whether the contact height may change in some recording."""
        return any(up.any() for up in self._ups)

    def others(self, setting: int) -> list[int]:
        """Return the settings whose differences from a setting estimate its discretisation error.

        Material points are compared with a finer step, a finer grid, and higher colliders (or a coarser grid where there is no contact).
        Finite elements meet a plane where it is declared. They are compared with a coarser mesh, one of other tetrahedra, and the grids of
        material points, because all meshes may have an error in common.
        """
        able = [i for i, s in enumerate(SETTINGS[: self.settings]) if i != setting]
        if setting == COARSE:
            able = [i for i in able if SETTINGS[i].solver == "finite_elements"] + [self.quick(0)]
        if EVERY[setting].solver == "finite_elements":
            return [i for i in able if not EVERY[i].lift]
        if EVERY[setting] in QUICK:
            able = [0, *(i for i, s in enumerate(settings.WHOLE) if s.dt == EVERY[setting].dt and i != setting)]
        without = (lambda s: s.cells < 1.0) if self.lifts else (lambda s: s.lift > 0.0)
        return [i for i in able if EVERY[i].solver == "material_points" and not without(EVERY[i])]

    def quick(self, setting: int) -> int:
        """Return the cheaper setting for a search: material points with a longer step, finite elements with a coarser mesh."""
        if self.settings == 1 or setting not in SOLVERS:
            return setting
        if SETTINGS[setting].solver == "finite_elements":
            return COARSE
        return EVERY.index(Setting(1.0, self._longer)) if self._longer > 1.0 else setting

    @functools.cached_property
    def _longer(self) -> float:
        """Factor on the suggested step that keeps the declared model stable and the frames on whole substeps; 1 if none does."""

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

    def early(self, setting: int, share: float) -> int:
        return settings.early(setting, share)

    def _lift(self, point: Point, recording: int, setting: int) -> np.ndarray:
        """Return the shift of the colliders of a recording along their normals [m], (3,)."""
        return (point.get(CONTACT_HEIGHT, 0.0) + EVERY[setting].lift * self.measured[recording].scene.dx) * self._ups[recording]

    def _full(self, point: Point) -> dict[str, float]:
        """Complete a parameter set with the declared values and effects."""
        return {p.name: p.value for p in self.declared} | self.experiment.model.get("effects", {}) | dict(point)

    def _effects(self, simulator: Simulator, full: Sequence[Point], recordings: Sequence[int], always: Sequence[str]) -> Effects:
        """Build the effects of each scene; fibres and gradients are those of the first recording's pose, and turn with the body."""
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
        """Build the declared laws for several parameter sets, one scene each."""
        return laws_of(self.experiment.model, points)

    def simulator(self, recordings: Sequence[int], setting: int, count: int) -> Simulator | FiniteElements:
        """Return a simulator of `count` copies of the scene of each recording; its buffers are kept for later calls of this thread."""
        setting = settings.whole(setting)
        key = (tuple(recordings), setting, count, threading.get_ident())
        with self._lock:
            found = self._simulators.pop(key, None)
            if found is None:
                found = self._made(recordings, setting, count, self.device)
                while len(self._simulators) >= KEPT[torch.device(self.device).type]:
                    self._simulators.pop(next(iter(self._simulators)))
            self._simulators[key] = found  # put last: the one that was used longest ago is given up first
        return found

    def free(self) -> None:
        """Release the memory of the simulators, with their buffers and captured launches."""
        with self._lock:
            self._simulators.clear()
        gc.collect()
        torch.cuda.empty_cache()

    def _made(self, recordings: Sequence[int], setting: int, count: int, device: str) -> Simulator | FiniteElements:
        s = EVERY[setting]
        scenes, bodies, meshes = [], [], []
        for n in recordings:
            r = self.measured[n]
            scenes += [replace(r.held_scene, cells=round(r.scene.cells * s.cells), dt=r.scene.dt * s.dt)] * count
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
        """Return the mesh of the body of a recording, which all simulators share because meshing takes seconds."""
        key = recording, elements, tetrahedra
        if key not in self._meshes:
            body = self.measured[recording].body
            wanted = None if elements == 1.0 else round(elements * len(body.x))
            self._meshes[key] = mesh_body(body.x, body.volume, elements=wanted, kind=tetrahedra)
        return self._meshes[key]

    def _start(self, simulator: Simulator, points: Sequence[Point], recordings: Sequence[int], lifts: np.ndarray) -> ParticleState:
        """Return the start with the velocity and spin of each parameter set, and with the bodies lowered by `lifts` (S, 3) [m].

        Scenes are ordered by recording, then by parameter set.
        """
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
        """Return the rotation (3, 3) from the body of the first recording to that of another one.

        It is the identity where the two are not the same particles in another pose (to 1 % of the body's size).
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
    """Return the factors of `FINER` that are tried with a complete parameter set."""
    return FINER if any(point.get(name, 0.0) > 0.0 for name in STIFFENING) else FINER[:2]


def _rollout_until_finite(simulator: FiniteElements, point: Point, *args: Any, **given: Any) -> Frames:
    """Simulate one scene with finite elements, with more inner steps (`FINER`) where the motion is not finite.

    Raises:
        UserError: The rollout fails with the most inner steps too.
    """
    *others, finest = _finer(point)
    for finer in others:
        try:
            return simulator.rollout(*args, **given, inner_factor=finer)
        except UserError:
            continue
    return simulator.rollout(*args, **given, inner_factor=finest)


def _up(r: Measured) -> np.ndarray:
    """Return the direction (3,) in which the contact height shifts the colliders of a recording: the sum of their normals.

    It is zero without colliders, where the body starts near one (`GAP`), and where the body is clamped, because clamps do not shift.
    """
    free = r.scene.colliders and not (r.scene.clamps or r.clamps) and _gap(r) > GAP * r.scene.dx
    return np.unique(_normals(r), axis=0).sum(axis=0) if free else np.zeros(3)


def _normals(r: Measured) -> list[np.ndarray]:
    """Return the unit normals of the colliders of a recording."""
    return [np.array(p.normal) / math.hypot(*p.normal) for p in r.scene.colliders]


def _gap(r: Measured) -> float:
    """Return the distance at the start between the body of a recording and its nearest collider [m]; infinite without colliders."""
    x = r.body.x.double().numpy()
    gaps = (float(((x - np.array(p.point)) @ n).min()) for p, n in zip(r.scene.colliders, _normals(r), strict=True))
    return min(gaps, default=math.inf)


def _for_lowered_body(point: dict[str, float], lift: np.ndarray) -> dict[str, float]:
    """Return a complete parameter set for a body that starts lower by `lift` (3,) [m]: places in space are lowered too."""
    own = {f"position_force.{a}": d for a, d in zip("xyz", lift, strict=True)}
    return {name: value - own.get(name, 0.0) for name, value in point.items()} if lift.any() else point


def _of_particles(lifts: np.ndarray, simulator: Simulator | FiniteElements) -> Tensor:
    """Spread the lift (3,) of each scene to its particles, (P, 3)."""
    return torch.from_numpy(lifts).to(simulator.state.x)[simulator.particles.scene.long()]
