"""What the closed loop asks of a forward model: its parameters, the effects it may lack, its recordings, and a prediction.

The bodies of the material point method, the material point and the point mass all answer to `Problem`; the inference
(`inference`) and the report know nothing else of them.
"""

import math
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

Point = Mapping[str, float]
"""Physical values of parameters by name; those that are absent take their `Parameter.value`."""
Ask = tuple[Sequence[Point], int, int]
"""Points, the number of a recording, and a setting: the arguments of `Problem.predict`."""
Rows = Generator[np.ndarray, None, None]
"""What each of several asks is answered, (len(points), n), as it comes."""
SURE = 1.3
"""Times a setting's step that must be stable for it to stand in for another one: a beam of a Poisson ratio of 0.494 failed at 1.15 in three
recordings of five, and moved by itself in the others."""


@dataclass(frozen=True)
class Parameter:
    """A figure that a fit may move."""

    name: str
    """Such as `young`, `release_time:drop`; that of an effect is `<effect>.<parameter>`, as `viscosity_shear.eta`."""
    unit: str
    value: float
    """Where the fit starts; for an effect what it takes where the effect is absent."""
    scale: float
    """A typical step: relative where `log`, else in the unit."""
    lower: float
    upper: float
    """Physical range, inclusive; a fit that ends at a bound of an effect counts as unphysical, unless it `saturates`."""
    log: bool = False
    """The fit moves the logarithm."""
    prior: float | None = None
    """Standard deviation of a Gaussian prior about `value`, in the coordinate of the fit; none: flat."""
    saturates: bool = False
    """At its upper bound an effect does all that it can: a fit that ends there is physical."""

    def coordinate(self, value: float) -> float:
        """The coordinate of the fit, of order one for a typical change."""
        return float(np.log(value) if self.log else value) / self.scale

    def physical(self, coordinate: float) -> float:
        """The inverse of `coordinate`, clipped to the range."""
        return self.within(float(np.exp(coordinate * self.scale) if self.log else coordinate * self.scale))

    def within(self, value: float) -> float:
        """The value, clipped to the range."""
        return min(max(value, self.lower), self.upper)

    @property
    def signs(self) -> tuple[float, ...]:
        """Those that its range has."""
        return (1.0, -1.0) if self.lower < 0 else (1.0,)


@dataclass(frozen=True)
class Candidate:
    """An effect that the model may lack."""

    name: str
    """Of the vocabulary of `neuido-diagnosis/2`."""
    parameters: tuple[Parameter, ...]
    starts: tuple[Mapping[str, float], ...]
    """Values of its parameters that the screening probes and that full fits start from."""
    where: str
    """The stage of the motion that gives it away."""
    form: str = ""
    """Where an effect has several forms (a gradient, an inclusion), which one this is."""
    sizes: tuple[str, ...] = ()
    """Names of the parameters whose zero is the effect's absence; the others give its shape. Empty: all are."""
    linear: bool = True
    """Whether small sizes act in proportion; a yield stress does not."""
    apart: str = ""
    """A size whose sign no fit changes, for at zero the effect's shape has no meaning: fits begin on either side."""
    far: float = 0.0
    """What `apart` is, up and down, where every start is tried once at full strength; zero: nowhere."""
    beside: Mapping[str, float] = field(default_factory=dict)
    """By how much of a size the logarithm of a declared parameter goes with it: a stiff part in a soft rest, as stiff together."""
    takes: tuple[str, ...] = ()
    """Declared parameters that a fit without the effect makes too large for the lack of it: a modulus, of what stiffens."""

    @property
    def key(self) -> str:
        """Name and form."""
        return f"{self.name}:{self.form}" if self.form else self.name

    @property
    def size_parameters(self) -> tuple[Parameter, ...]:
        """The parameters that vanish with the effect."""
        return tuple(p for p in self.parameters if not self.sizes or p.name in self.sizes)

    def shape(self, point: Point) -> tuple[float, ...]:
        """What a point has of the other parameters."""
        return tuple(point.get(p.name, p.value) for p in self.parameters if p not in self.size_parameters)

    def times(self, start: Mapping[str, float], factors: Sequence[float]) -> dict[str, float]:
        """A start with its sizes times factors, clipped to their ranges."""
        sizes = {p.name: p.within(start[p.name] * f) for p, f in zip(self.size_parameters, factors, strict=True)}
        return dict(start) | sizes

    def own(self, point: Point) -> dict[str, float]:
        """What a point has of this effect."""
        return {name: value for name, value in point.items() if name.startswith(f"{self.name}.")}

    def without(self, point: Point) -> dict[str, float]:
        """What a point has beside this effect."""
        return {name: value for name, value in point.items() if not name.startswith(f"{self.name}.")}


@dataclass(frozen=True, eq=False)
class Recording:
    """Measured data of one recording as one vector."""

    name: str
    role: str
    """`fit`, or `held_out`: only ever scored."""
    y: np.ndarray
    """(n,) float64 without NaN."""
    noise: float | None
    """Standard deviation of its independent part; none: not known."""
    groups: np.ndarray
    """(n,) whole numbers; rows of one group are samples of one quantity in the order of time."""
    times: np.ndarray
    """(n,) time [s] of each row, or its order where there is no time."""
    noise_from: str = "stated"
    """Where the noise comes from: it is `stated`, or `estimated` from the data."""


@dataclass(frozen=True, eq=False)
class Problem:
    """A model with its data. Subclasses implement `predict` and `model_after`."""

    name: str
    measure: str
    unit: str
    declared: tuple[Parameter, ...]
    nuisances: tuple[Parameter, ...]
    candidates: tuple[Candidate, ...]
    recordings: tuple[Recording, ...]
    settings: int = 1
    """Settings of the discretisation; 0 is the suggested one, and 1 of them means that nothing is discretised."""
    solvers: tuple[int, ...] = (0,)
    """The settings that are methods of their own: the data choose among them."""
    labels: dict[str, Any] = field(default_factory=dict)
    """What the report says beside the figures."""

    def predict(self, points: Sequence[Point], recording: int, setting: int = 0) -> np.ndarray:
        """The data that each point predicts, (len(points), n); a row of NaN where the model cannot run there."""
        raise NotImplementedError

    def predict_several(self, asks: Sequence[Ask]) -> Rows:
        """What `predict` says to each of several asks, in their order: run side by side where one after the other leaves cores idle."""
        return (self.predict(*ask) for ask in asks)

    def margin(self, point: Point, setting: int = 0) -> float:
        """How far a point lies from where the model cannot run any more, as the logarithm of a ratio; below zero it does not run.

        Computed without a run; infinite where nothing is known.
        """
        return math.inf

    def refusal(self, setting: int) -> str:
        """Return why the declared model has no finite prediction under a setting, and the factor that would let it run."""
        return f"the declared model has no finite prediction ({self.setting_name(setting)}): check its values and units"

    def bears(self, point: Point, setting: int) -> bool:
        """Whether a point is `SURE` to run under a setting that is to stand in for another one."""
        return self.margin(point, setting) >= math.log(SURE)

    def effort(self, recording: int, setting: int = 0) -> float:
        """What one prediction costs, in a unit of the model's own (particle-substeps of a body); data where that says enough."""
        return float(len(self.recordings[recording].y))

    @property
    def together(self) -> bool:
        """Whether several points cost about as much as one, so that a fit asks for all that it may want at once."""
        return True

    def directions(self, recording: int) -> np.ndarray:
        """Smooth patterns in which an unknown part of the discretisation error may lie, (n, k), of mean square one together."""
        return np.empty((len(self.recordings[recording].y), 0))

    def error(self, residual: np.ndarray, recording: int) -> float:
        """A residual (n,) as one figure in `unit`."""
        return float(np.sqrt(np.mean(residual**2)))

    def others(self, setting: int) -> list[int]:
        """The other settings whose differences to one are directions that the data may lie in, whatever the law."""
        return [s for s in range(self.settings) if s != setting]

    def quick(self, setting: int) -> int:
        """A setting that moves about as one does for less, which stands in for it while a search has far to go; itself if there is none."""
        return setting

    def recentred(self, point: Point, setting: int, amounts: Sequence[float]) -> Point:
        """The point moved to where amounts of the differences to `others` lead, as far as a parameter of the problem's own can go there."""
        return point

    def setting_name(self, setting: int) -> str:
        """What a setting is, for the report."""
        return "suggested" if setting == 0 else f"setting {setting}"

    def model_after(self, values: Point, effects: Sequence[str]) -> dict[str, Any]:
        """The content of `model_after.yaml`: the folder's model with these values and effects."""
        raise NotImplementedError

    @property
    def roles(self) -> dict[str, list[int]]:
        """Numbers of the recordings by role."""
        return {role: [i for i, r in enumerate(self.recordings) if r.role == role] for role in ("fit", "held_out")}

    def parameter(self, name: str) -> Parameter:
        """The parameter of a name."""
        for p in (*self.declared, *self.nuisances, *(p for c in self.candidates for p in c.parameters)):
            if p.name == name:
                return p
        raise KeyError(name)
