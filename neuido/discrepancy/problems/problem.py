"""The interface between a diagnosis and a forward model: parameters, candidate effects, recordings and predictions.

Deforming bodies, material tests and tracks are subclasses of `Problem`. The inference and the report use nothing but this interface.
"""

import math
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

Point = Mapping[str, float]
"""A parameter set: physical values by name. A parameter without an entry has its `Parameter.value`."""
Ask = tuple[Sequence[Point], int, int]
"""A request for predictions, the arguments of `Problem.predict`: parameter sets, number of the recording, number of the setting."""
Rows = Generator[np.ndarray, None, None]
"""Predictions (len(points), n) of each request, in turn."""
SURE = 1.3
"""Factor by which the time step of a setting must stay below the stability limit before it may replace another setting.

At a factor of 1.15, a beam with a Poisson's ratio of 0.494 diverged in three recordings of five and moved by itself in the others.
"""


@dataclass(frozen=True)
class Parameter:
    """A quantity that a fit may change."""

    name: str
    """For example `young` or `release_time:drop`. A parameter of an effect is `<effect>.<parameter>`, as `viscosity_shear.eta`."""
    unit: str
    value: float
    """Start of the fit. For an effect: the value at which the effect is absent."""
    scale: float
    """Typical step, relative if `log`, else in `unit`."""
    lower: float
    upper: float
    """Physical range, inclusive. A fit of an effect that ends at a bound counts as unphysical, unless `saturates`."""
    log: bool = False
    """Whether the logarithm is fitted."""
    prior: float | None = None
    """Standard deviation of a Gaussian prior about `value`, in the coordinate of the fit. None: a flat prior."""
    saturates: bool = False
    """Whether the effect is complete at its upper bound, so that a fit that ends there is physical."""

    def coordinate(self, value: float) -> float:
        """Return the dimensionless coordinate that is fitted for a physical value; a typical change is of order one."""
        return float(np.log(value) if self.log else value) / self.scale

    def physical(self, coordinate: float) -> float:
        """Return the physical value for a coordinate of the fit, clipped to the range."""
        return self.within(float(np.exp(coordinate * self.scale) if self.log else coordinate * self.scale))

    def within(self, value: float) -> float:
        """Return a physical value, clipped to the range."""
        return min(max(value, self.lower), self.upper)

    @property
    def signs(self) -> tuple[float, ...]:
        """Signs that values in the range can have."""
        return (1.0, -1.0) if self.lower < 0 else (1.0,)


@dataclass(frozen=True)
class Candidate:
    """An effect that the model may lack."""

    name: str
    """Name in the file format `neuido-diagnosis/2`."""
    parameters: tuple[Parameter, ...]
    starts: tuple[Mapping[str, float], ...]
    """Parameter values that the screening tries and that full fits start from."""
    where: str
    """Stage of the motion in which the effect shows, such as `flight` or `contact`."""
    form: str = ""
    """Form of an effect that has several, such as `gradient` or `inclusion` for the stiffness."""
    sizes: tuple[str, ...] = ()
    """Names of the parameters that are zero when the effect is absent. The others describe its shape. Empty: all parameters are sizes."""
    linear: bool = True
    """Whether a small effect is proportional to its size (a yield stress is not)."""
    apart: str = ""
    """Size whose sign a fit cannot change, because at zero the shape has no meaning. Fits start on both sides of zero. Empty: none."""
    far: float = 0.0
    """Value of `apart`, with both signs, at which every start is also tried at full strength. Zero: not tried."""
    beside: Mapping[str, float] = field(default_factory=dict)
    """Change of the logarithm of a declared parameter per unit of the size, which keeps the whole body about as stiff as before."""
    takes: tuple[str, ...] = ()
    """Declared parameters that a fit overestimates while the effect is missing, such as the modulus of a body that stiffens."""
    needs: str = ""
    """Effect that must be in the model before this one is offered, such as `yield` for its hardening. Empty: none."""

    @property
    def key(self) -> str:
        """Name, with the form after a colon where there is one."""
        return f"{self.name}:{self.form}" if self.form else self.name

    @property
    def size_parameters(self) -> tuple[Parameter, ...]:
        """Parameters that are zero when the effect is absent."""
        return tuple(p for p in self.parameters if not self.sizes or p.name in self.sizes)

    def shape(self, point: Point) -> tuple[float, ...]:
        """Return the values of the parameters of shape (those that are not sizes) in a parameter set."""
        return tuple(point.get(p.name, p.value) for p in self.parameters if p not in self.size_parameters)

    def times(self, start: Mapping[str, float], factors: Sequence[float]) -> dict[str, float]:
        """Return a start with each size multiplied by its factor and clipped to its range."""
        sizes = {p.name: p.within(start[p.name] * f) for p, f in zip(self.size_parameters, factors, strict=True)}
        return dict(start) | sizes

    def own(self, point: Point) -> dict[str, float]:
        """Return the entries of a parameter set that belong to this effect."""
        return {name: value for name, value in point.items() if name.startswith(f"{self.name}.")}

    def without(self, point: Point) -> dict[str, float]:
        """Return a parameter set without the entries of this effect."""
        return {name: value for name, value in point.items() if not name.startswith(f"{self.name}.")}


@dataclass(frozen=True, eq=False)
class Recording:
    """Measured data of one recording as a vector."""

    name: str
    role: str
    """`fit`, or `held_out` (scored, never fitted)."""
    y: np.ndarray
    """Data, (n,) float64 without NaN."""
    noise: float | None
    """Standard deviation of the independent noise, in the unit of the data. None: not known."""
    groups: np.ndarray
    """Series that each value belongs to, (n,) integers. A series holds samples of one quantity in the order of time."""
    times: np.ndarray
    """Time of each value [s], (n,); its place in the file where no time was measured."""
    noise_from: str = "stated"
    """Origin of `noise`: `stated` in the folder, or `estimated` from the data."""


@dataclass(frozen=True, eq=False)
class Problem:
    """Measured data with a declared model; subclasses implement `predict` and `model_after`."""

    name: str
    measure: str
    unit: str
    declared: tuple[Parameter, ...]
    nuisances: tuple[Parameter, ...]
    candidates: tuple[Candidate, ...]
    recordings: tuple[Recording, ...]
    settings: int = 1
    """Number of settings (grid, time step, mesh, method). Setting 0 is the suggested one. 1: the model is not discretised."""
    solvers: tuple[int, ...] = (0,)
    """Settings that stand for a simulation method each. The data choose among them."""
    labels: dict[str, Any] = field(default_factory=dict)
    """Facts for the report: `kind` of the data, `body`, effects that are `excluded`, with the reason, `ordinary` sizes that parameters of
    effects have by the declared figures, and what the data leave `unseen`."""

    def predict(self, points: Sequence[Point], recording: int, setting: int = 0) -> np.ndarray:
        """Predict the data of a recording for each parameter set, (len(points), n); a row is NaN where the simulation fails."""
        raise NotImplementedError

    def predict_several(self, asks: Sequence[Ask]) -> Rows:
        """Yield the result of `predict` for each request, in their order.

        Subclasses run the requests in parallel where that uses more cores.
        """
        return (self.predict(*ask) for ask in asks)

    def margin(self, point: Point, setting: int = 0) -> float:
        """Return the logarithm of the stability limit over the time step for a parameter set; a negative margin cannot be simulated.

        The margin is computed without a simulation. It is infinite where no limit is known.
        """
        return math.inf

    def refusal(self, setting: int) -> str:
        """Return why the declared model has no finite prediction under a setting, and the factor that would let it run."""
        return f"the declared model has no finite prediction ({self.setting_name(setting)}): check its values and units"

    def bears(self, point: Point, setting: int) -> bool:
        """Return whether a parameter set stays stable, by the factor `SURE`, under a setting that is to replace another one."""
        return self.margin(point, setting) >= math.log(SURE)

    def effort(self, recording: int, setting: int = 0) -> float:
        """Return the cost of one prediction: particle-substeps of a simulated body, else the number of data."""
        return float(len(self.recordings[recording].y))

    @property
    def together(self) -> bool:
        """Whether predictions of several parameter sets cost about as much as one, so that a fit may request them all at once."""
        return True

    def directions(self, recording: int) -> np.ndarray:
        """Return smooth patterns (n, k) that describe a discretisation error of unknown shape.

        The squares of the k patterns add up to one, in the mean over the n values.
        """
        return np.empty((len(self.recordings[recording].y), 0))

    def shown(self, point: Point, p: Parameter) -> tuple[float, float]:
        """Return the range of a declared figure that slow and fast measurements show; its value, twice, where time has no part in it."""
        value = point.get(p.name, p.value)
        return value, value

    def instrument_errors(self, point: Point, recording: int) -> np.ndarray:
        """Return how one standard deviation of each error of the instruments that no nuisance has changes a recording, (n, k).

        The fit cannot take these errors up. They limit what the data can exclude.
        """
        return np.empty((len(self.recordings[recording].y), 0))

    def error(self, residual: np.ndarray, recording: int) -> float:
        """Return the root mean square of a residual (n,), in `unit`."""
        return float(np.sqrt(np.mean(residual**2)))

    def noise_with(self, point: Point, recording: int) -> float | None:
        """Return the standard deviation of what noise and nuisances leave of a recording where the model at a point is right.

        None: it is the noise of the recording.
        """
        return self.recordings[recording].noise

    def others(self, setting: int) -> list[int]:
        """Return the settings whose differences from a setting estimate its discretisation error."""
        return [s for s in range(self.settings) if s != setting]

    def quick(self, setting: int) -> int:
        """Return a cheaper setting with about the same motion for the early search, or the setting itself if there is none."""
        return setting

    def early(self, setting: int, share: float) -> int:
        """Return a setting that predicts as this one does for this share of the time, without what follows if that is cheaper.

        The data that follow have finite predictions without a meaning.
        """
        return setting

    def recentred(self, point: Point, setting: int, amounts: Sequence[float]) -> Point:
        """Return a parameter set in which a parameter of the problem takes over differences between settings, where one can.

        Args:
            point: The parameter set.
            setting: The setting that predicts.
            amounts: Amount of the difference of each of the settings `others(setting)` in the prediction.
        """
        return point

    def setting_name(self, setting: int) -> str:
        """Return the name of a setting for the report."""
        return "suggested" if setting == 0 else f"setting {setting}"

    def model_after(self, values: Point, effects: Sequence[str]) -> dict[str, Any]:
        """Return the content of `model_after.yaml`: the declared model with fitted values and added effects."""
        raise NotImplementedError

    @property
    def roles(self) -> dict[str, list[int]]:
        """Numbers of the recordings of each role, `fit` and `held_out`."""
        return {role: [i for i, r in enumerate(self.recordings) if r.role == role] for role in ("fit", "held_out")}

    def parameter(self, name: str) -> Parameter:
        """Return the parameter with a name.

        Raises:
            KeyError: No such parameter.
        """
        for p in (*self.declared, *self.nuisances, *(p for c in self.candidates for p in c.parameters)):
            if p.name == name:
                return p
        raise KeyError(name)
