"""A scene that is simulated while one looks at it: play, pause, step, reset, pull, and other gravity and laws, in a thread of its own."""

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from neuido.errors import UserError, one_line, shortened
from neuido.physics.effects.parameters import Effects
from neuido.types import ParticleState
from neuido.viewer.live.live_colliders import LiveColliders

CHUNK_SECONDS = 0.04
"""Time that a chunk of substeps should take [s], after which the page is drawn: 25 pictures a second."""
LEAST_SUBSTEPS, MOST_SUBSTEPS = 8, 400
"""Substeps of a chunk at least, since a call has a cost of its own, and at most, so that a change on the page is followed soon."""
PULL_PHASE = 0.3
"""Largest phase [rad] by which the spring of a pull turns between two of its kicks; stable below 2."""
DAMPING = 0.7
"""Damping ratio of the spring of a pull."""
GRIP = 0.15
"""Radius of the particles that a pull holds, relative to the size of the body."""
CROSSING = 0.4
"""Largest share of a cell by which a pull may make a particle move in a substep."""


@dataclass
class Parameter:
    """A number of the law that a slider changes.

    Args:
        name: As in the scene file, such as `young`.
        unit: SI unit; empty for pure numbers.
        value: At the start.
        low: Smallest value.
        high: Largest value.
        logarithmic: Whether the slider moves the logarithm.
    """

    name: str
    unit: str
    value: float
    low: float
    high: float
    logarithmic: bool = False


class LawFamily(NamedTuple):
    """Laws with parameters that can be changed: a function from their values to the elastic and the plastic law."""

    make: Callable[[Mapping[str, float]], tuple[Any, Any]]
    parameters: tuple[Parameter, ...]
    effects: Effects | None = None
    """Effects beside the laws; what they remember begins anew with each stretch of the motion."""


def classical_family(elasticity: Mapping[str, Any], plasticity: Mapping[str, Any], effects: Mapping[str, float] | None = None) -> LawFamily:
    """Return the family of a classical material with the parameters and the effects of a scene file."""
    from neuido.physics.laws.classical import material

    ranges = {
        "poisson": ("", 0.0, 0.49, False),
        "friction_angle": ("degrees", 0.0, 60.0, False),
        "limit": ("", 0.1, 100.0, True),
        "exponent": ("", 1.0, 12.0, False),
        "compression": ("", 0.001, 0.1, True),
        "stretch": ("", 0.001, 0.1, True),
    }
    found = []
    for part in (elasticity, plasticity):
        for name, value in part.items():
            if name != "law" and isinstance(value, int | float):
                unit, low, high, logarithmic = ranges.get(name, ("Pa", float(value) / 30.0, 30.0 * float(value), True))
                found.append(Parameter(name, unit, float(value), min(low, float(value)), max(high, float(value)), logarithmic))

    def make(values: Mapping[str, float]) -> tuple[Any, Any]:
        return material(*({key: values.get(key, value) for key, value in part.items()} for part in (elasticity, plasticity)))

    return LawFamily(make, tuple(found), Effects.of(effects) if effects else None)


def latent_family(operator: Any, a: Tensor, b: Tensor) -> LawFamily:
    """Return the family of the laws between two latents of an operator; its parameter is the share of the second."""

    def make(values: Mapping[str, float]) -> tuple[Any, Any]:
        with torch.no_grad():
            return operator.laws(torch.lerp(a, b, values["share"]))

    return LawFamily(make, (Parameter("share", "", 0.0, 0.0, 1.0),))


class Pull(NamedTuple):
    """A spring between particles and a target."""

    particles: Tensor
    """Indices of the particles, (n,) int64."""
    weights: Tensor
    """Their shares of the pull, largest in the middle, (n, 1)."""
    offset: Tensor
    """From their centre to the point that was gripped [m], (3,)."""
    target: Tensor
    """Where that point is pulled to [m], (3,)."""


class LiveRun:
    """A simulation in a thread, which a page steers.

    Args:
        simulator: A `Simulator` of one scene.
        family: The laws and their parameters; a plain pair of laws has none.
        shown: Function that is called in the thread after each chunk and each change.

    Attributes:
        state: Positions, velocities and deformation gradients now.
        time: Simulated time [s].
        error: What ended the last run, one line; empty where nothing did.
        pace: Simulated time per time of the clock.
        frequency: Frequency of the spring of a pull [Hz]: its stiffness is mass times the square of 2 pi times it.
        force: Force of the pull in the last chunk [N], (3,).
        colliders: The solid colliders and their poses.
    """

    def __init__(self, simulator: Any, family: LawFamily, shown: Callable[[], None] = lambda: None) -> None:
        self.simulator, self.family, self.shown = simulator, family, shown
        if simulator.scene_count != 1:
            raise UserError(f"the simulator has {simulator.scene_count} scenes; a live page shows one")
        self.scene = simulator.scenes[0]
        self.values = {each.name: each.value for each in family.parameters}
        self.laws = family.make(self.values)
        self.gravity = tuple(float(g) for g in self.scene.gravity)
        self.speed, self.frequency = 1.0, 3.0
        self.playing, self.error, self.pace, self.time = False, "", 0.0, 0.0
        self.state: ParticleState = simulator.state
        self.force = np.zeros(3)
        self.colliders = LiveColliders(simulator)
        self.steps_done = 0
        self._pull: Pull | None = None
        self._substeps, self._single, self._reset, self._dirty = LEAST_SUBSTEPS, 0, False, False
        self._changed, self._lock, self._ended = threading.Event(), threading.RLock(), threading.Event()
        self._thread = threading.Thread(target=self._work, daemon=True)

    def start(self) -> None:
        """Start the thread; the simulation begins paused."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread."""
        self._ended.set()
        self._changed.set()
        if self._thread.is_alive():
            self._thread.join(timeout=10.0)

    # What a page asks for; it is done in the thread.

    def play(self, on: bool = True) -> None:
        """Run, or pause."""
        self.playing = on
        self._changed.set()

    def step(self, count: int = 1) -> None:
        """Do one chunk of substeps while paused."""
        self._single += count
        self._changed.set()

    def reset(self) -> None:
        """Return to t = 0; parameters and gravity stay as they are."""
        self._reset = True
        self._changed.set()

    def change(self, name: str, value: float) -> None:
        """Change a parameter of the law."""
        with self._lock:
            self.values[name] = float(value)
            self._dirty = True
        self._changed.set()

    def move_collider(self, index: int, position: np.ndarray) -> None:
        """Move a collider towards a position [m], as fast as the grid allows."""
        with self._lock:
            self.colliders.targets[index] = np.array(position, float)
        self._changed.set()

    def grip(self, point: np.ndarray) -> None:
        """Take hold of the body at a point [m]: the particles within `GRIP` times its size, or the nearest ones."""
        with self._lock:
            x = self.state.x
            at = torch.as_tensor(np.asarray(point), dtype=x.dtype, device=x.device)
            size = float((x.amax(dim=0) - x.amin(dim=0)).norm())
            distance = (x - at).norm(dim=1)
            radius = max(GRIP * size, float(distance.kthvalue(min(8, len(x))).values) * 1.001, 1e-12)
            own = torch.nonzero(distance < radius)[:, 0]
            weights = (1.0 - (distance[own] / radius) ** 2)[:, None]
            self._pull = Pull(own, weights, at - _centre(x[own], weights), at)

    def drag(self, target: np.ndarray) -> None:
        """Pull what was gripped towards a point [m]."""
        with self._lock:
            if self._pull is not None:
                like = self._pull.target
                self._pull = self._pull._replace(target=torch.as_tensor(np.asarray(target), dtype=like.dtype, device=like.device))
        self._changed.set()

    def release(self) -> None:
        """Let go."""
        with self._lock:
            self._pull, self.force = None, np.zeros(3)

    def held(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Return where the gripped point is and where it is pulled to [m]; None where nothing is held."""
        with self._lock:
            if self._pull is None:
                return None
            own = _centre(self.state.x[self._pull.particles], self._pull.weights) + self._pull.offset
            return own.cpu().numpy(), self._pull.target.cpu().numpy()

    # The thread.

    def _work(self) -> None:
        while not self._ended.is_set():
            if not (self.playing or self._single or self._reset or self._dirty):
                self._changed.wait(timeout=0.5)
                self._changed.clear()
                continue
            begun = time.monotonic()
            try:
                self._turn()
            except Exception as error:  # whatever fails is shown in the page, which goes on
                self._fail(error)
            self.shown()
            if self.playing and self.pace:
                self._ended.wait(max(0.0, self._real_seconds() - (time.monotonic() - begun)))

    def _real_seconds(self) -> float:
        """Return the time that the last chunk has on the clock at the chosen speed [s]."""
        return self._last * self.scene.dt / max(self.speed, 1e-9)

    _last = 0

    def _turn(self) -> None:
        """Do what was asked for, then a chunk of substeps if the simulation runs."""
        with self._lock:
            if self._reset:
                self.state, self.time, self.error, self._reset = self.simulator.state, 0.0, "", False
                self.steps_done, self.pace = 0, 0.0
                self._pull = None
                self.colliders.reset()
            if self._dirty:
                self._dirty, self.error = False, ""
                self.laws = self.family.make(self.values)
        if self.playing or self._single:
            self._single = max(0, self._single - 1)
            self._chunk(self._count())

    def _count(self) -> int:
        """Return the substeps of the next chunk: as many as take `CHUNK_SECONDS`, but no more than the chosen speed lets pass."""
        count = min(self._substeps, MOST_SUBSTEPS, max(1, round(self.speed * CHUNK_SECONDS / self.scene.dt)))
        if self._pull is not None:
            count = min(count, int(PULL_PHASE / (2 * np.pi * self.frequency * self.scene.dt)))
        return max(1, count)

    def _chunk(self, count: int) -> None:
        begun = time.monotonic()
        with torch.no_grad():
            with self._lock:
                start = self._kicked(self.state, count * self.scene.dt)
            gravity = torch.tensor([self.gravity], dtype=start.x.dtype)
            given = tuple(law for law in self.laws if law is not None)
            with self._lock:
                solids = self.colliders.inputs(count, self.time)
            options = {"gravity": gravity, "solids": solids, "effects": self.family.effects}
            frames = self.simulator.rollout(count, *given, state=start, every=count, **options)
            after = ParticleState(*(part[-1].clone() for part in frames))
        spent = max(time.monotonic() - begun, 1e-6)
        with self._lock:
            if self._reset:
                return
            self.colliders.follow(frames)
            self.state, self.time, self._last = after, self.time + count * self.scene.dt, count
            self.steps_done += count
        self.pace = count * self.scene.dt / max(spent, self._real_seconds())
        wanted = count * CHUNK_SECONDS / spent
        self._substeps = int(np.clip(0.5 * self._substeps + 0.5 * wanted, LEAST_SUBSTEPS, MOST_SUBSTEPS))

    def _kicked(self, state: ParticleState, seconds: float) -> ParticleState:
        """Return the state with the velocities that the pull gives over a chunk."""
        pull = self._pull
        if pull is None:
            return state
        turn = 2.0 * np.pi * self.frequency
        x, v = state.x[pull.particles], state.v[pull.particles]
        apart = pull.target - (_centre(x, pull.weights) + pull.offset)
        gain = seconds * (turn**2 * apart - 2.0 * DAMPING * turn * _centre(v, pull.weights))
        largest = CROSSING * self.scene.dx / self.scene.dt
        gain = gain * min(1.0, largest / max(float(gain.norm()), 1e-30))
        mass = self.simulator.mass[pull.particles][:, None]
        self.force = ((mass * pull.weights).sum() * gain / seconds).cpu().numpy()
        velocity = state.v.clone()
        velocity[pull.particles] += pull.weights * gain
        return state._replace(v=velocity)

    def _fail(self, error: Exception) -> None:
        self.playing, self._single = False, 0
        self.error = one_line(error) or shortened(f"{type(error).__name__}: {error}")


def _centre(values: Tensor, weights: Tensor) -> Tensor:
    return (weights * values).sum(dim=0) / weights.sum()
