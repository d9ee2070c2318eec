"""Records of a diagnosis: every round and every fit that its decision rests on, immutable and without arrays, and their JSON format."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from typing import Any

import numpy as np

from neuido.discrepancy.inference.floors import Part, Round, Stand
from neuido.discrepancy.problems.problem import Candidate, Parameter, Problem

FORMAT = "neuido-fits/1"


@dataclass(frozen=True)
class FitRecord:
    """A fit of the declared model, with or without effects, by one method."""

    method: int
    """Number of the setting that stands for the method."""
    effects: tuple[str, ...]
    """Keys of the effects; none for the declared model alone."""
    point: Mapping[str, float]
    """Parameter values where the fit ended, by name."""
    names: tuple[str, ...]
    """Names of the parameters that were fitted."""
    cost: float
    """Sum of squares of the whitened residuals, priors included."""
    converged: bool
    """Whether the fit converged."""
    evaluations: int
    """Number of points that the fit evaluated."""
    setting: int
    """Number of the setting that the fit was made with; a search may use a quicker one than `method`."""
    errors: tuple[float, ...]
    """Mean square of the residual of each part."""
    spread: tuple[float, ...]
    """Mean square of the differences between settings in each part, at the point."""
    alone: tuple[float, ...] | None = None
    """Mean square of the residual of each part under one setting, without differences between settings; none: not computed."""
    finished: "FitRecord | None" = None
    """The same fit continued until its gains are far below the noise; none: not done."""

    @property
    def digest(self) -> str:
        """Return a hash of the method, the effects and the parameter values."""
        content = [self.method, sorted(self.effects), sorted(self.point.items())]
        return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16]


@dataclass(frozen=True)
class RoundRecord:
    """A round: the base model, the fits of candidates beside it, and the decision about them; see `floors.Round`."""

    method: int
    """Number of the setting that stands for the method."""
    base: Mapping[str, float]
    """Parameter values of the base model, by name."""
    errors: tuple[float, ...]
    """Mean square of the residual of the base in each part."""
    floors: tuple[float, ...]
    """Mean square that noise and discretisation alone leave of each part after a refit."""
    null: tuple[float, ...]
    """Largest gain in each draw under the null hypothesis."""
    exact_null: tuple[float, ...]
    """The same without discretisation error; empty if it was not drawn."""
    unfitted: Mapping[str, str]
    """Why a candidate was not fitted, by key."""
    fits: tuple[FitRecord, ...]
    """Fits of the candidates."""
    p_value: float
    """Probability of a gain as large under the null hypothesis."""
    chosen: str | None
    """Key of the candidate that is named, if any."""
    members: tuple[str, ...]
    """Keys of the candidates that the data cannot tell from the chosen one."""
    reasons: Mapping[str, str]
    """Why a candidate was rejected, by key; empty: it was not."""


@dataclass(frozen=True)
class StepRecord:
    """A step of the final answer: a round after all changes by later rounds. Fields are those of `RoundRecord`."""

    judged: int | None
    """Number of the round in the case; none if no effect was looked for."""
    base: Mapping[str, float]
    errors: tuple[float, ...]
    floors: tuple[float, ...]
    chosen: str | None
    members: tuple[str, ...]
    unsure: bool
    """Whether an effect gained enough, but there was no time to check it by the other method."""


@dataclass(frozen=True)
class CaseRecord:
    """Everything that the decision of one diagnosis rests on."""

    name: str
    """Name of the problem."""
    method: int
    """Number of the setting that stands for the method of the answer."""
    discretised: bool
    """Whether the model is a simulation with several settings."""
    parts: tuple[tuple[int, bool, int, str], ...]
    """Number of the recording, whether it is fitted, number of rows, and name of each part."""
    recordings: tuple[tuple[str, str, int, float, str], ...]
    """Name, role, number of data, standard deviation of the noise, and where the noise comes from, of each recording."""
    declared: tuple[Mapping[str, Any], ...]
    """Declared parameters."""
    candidates: tuple[Mapping[str, Any], ...]
    """Candidate effects."""
    bases: tuple[FitRecord, ...]
    """Fits of the declared model, by each method."""
    judged: tuple[RoundRecord, ...]
    """All rounds, in order."""
    steps: tuple[StepRecord, ...]
    """Rounds that the answer consists of."""
    before: FitRecord
    """Fit of the declared model."""
    after: FitRecord
    """Fit of the final model."""
    answer: str
    """See the glossary: `effect`, `class`, `none`, `unknown`, `insufficient` or `unfinished`."""
    effects: tuple[str, ...]
    """Keys of the effects of the answer."""
    why: tuple[str, ...]
    """Reasons for the answer, in words."""
    facts: Mapping[str, Any]
    """Further facts for the decision: was the search cut off, which fitted values are suspicious, does no other setting run."""
    work: Mapping[str, Mapping[str, float]]
    """Simulations, effort and time [s] of each step of the search."""


@dataclass(eq=False)
class Journal:
    """Collects the records while a diagnosis runs. All methods of a diagnosis share one journal."""

    rounds: list[RoundRecord] = field(default_factory=list)
    """All rounds, in order."""
    bases: list[FitRecord] = field(default_factory=list)
    """Fits of the declared model, by each method."""
    alone: dict[tuple, tuple[float, ...]] = field(default_factory=dict)
    """Mean squares of the parts under one setting alone (`FitRecord.alone`), by `place`."""

    def judged(
        self,
        method: int,
        result: Round,
        stands: Sequence[tuple[Candidate, Stand]],
        parts: Sequence[Part],
        finished: Mapping[str, Stand],
        exact_null: np.ndarray,
    ) -> int:
        """Add a round, and return its number.

        Args:
            method: Number of the setting that stands for the method.
            result: The round.
            stands: Fits of the candidates that the decision used.
            parts: Parts of the data.
            finished: Fits that were continued until their gains are far below the noise, by key of the candidate.
            exact_null: Largest gain in each draw without discretisation error; empty if none was drawn.
        """
        fits = [self.fit(method, result.base, c, stand, parts, finished.get(c.key)) for c, stand in stands]
        self.rounds.append(
            RoundRecord(
                method,
                dict(result.base),
                _floats(result.errors),
                _floats(result.floors),
                _floats(result.null),
                _floats(exact_null),
                dict(result.unfitted),
                tuple(fits),
                result.p_value,
                result.chosen.candidate.key if result.chosen else None,
                tuple(t.candidate.key for t in result.members),
                {t.candidate.key: t.reason for t in result.trials},
            )
        )
        return len(self.rounds) - 1

    def fit(
        self,
        method: int,
        base: Mapping[str, float],
        c: Candidate | None,
        stand: Stand,
        parts: Sequence[Part],
        finished: Stand | None = None,
    ) -> FitRecord:
        """Make the record of a fit.

        Args:
            method: Number of the setting that stands for the method.
            base: Parameter values of the base model; its effects are those of the fit too.
            c: The candidate that was added; none for the base model itself.
            stand: The fit.
            parts: Parts of the data.
            finished: The same fit continued, as in `FitRecord.finished`.
        """
        beside = dict.fromkeys(name.partition(".")[0] for name in base if "." in name)
        effects = tuple(key for key in (*beside, *([c.key] if c else [])))
        fit = stand.fit
        known = stand.floor is not None and all(p.recording in stand.floor.spread for p in parts)
        spread = stand.floor.spread_squares(parts) if known else np.zeros(len(parts))
        return FitRecord(
            method,
            effects,
            {name: float(value) for name, value in fit.point.items()},
            tuple(fit.names),
            float(fit.cost),
            bool(fit.converged),
            int(fit.evaluations),
            int(fit.setting),
            _floats(stand.errors),
            _floats(spread),
            self.alone.get(place(method, stand)),
            self.fit(method, base, c, finished, parts) if finished is not None else None,
        )

    def steps(self, rounds: Sequence[Round]) -> tuple[StepRecord, ...]:
        """Make the records of the rounds that an answer consists of."""
        return tuple(
            StepRecord(
                r.record,
                dict(r.base),
                _floats(r.errors),
                _floats(r.floors),
                r.chosen.candidate.key if r.chosen else None,
                tuple(t.candidate.key for t in r.members),
                r.unsure,
            )
            for r in rounds
        )


def place(method: int, stand: Stand) -> tuple:
    """Return a key that identifies a fit: method, parameter values and errors."""
    return method, tuple(sorted(stand.fit.point.items())), tuple(stand.errors.tolist())


def candidate_to_dict(c: Candidate) -> dict[str, Any]:
    """Convert a candidate to a dictionary of plain values."""
    own = {f.name: getattr(c, f.name) for f in fields(c) if f.name not in ("parameters", "starts", "beside")}
    own |= {"sizes": list(c.sizes), "takes": list(c.takes)}
    return {**own, "parameters": [asdict(p) for p in c.parameters], "starts": [dict(s) for s in c.starts], "beside": dict(c.beside)}


def candidate_from_dict(content: Mapping[str, Any]) -> Candidate:
    """Make a candidate from a dictionary of `candidate_to_dict`."""
    tuples = {k: tuple(content[k]) for k in ("sizes", "takes")}
    parameters = tuple(Parameter(**p) for p in content["parameters"])
    return Candidate(**{**content, **tuples, "parameters": parameters, "starts": tuple(content["starts"])})


def problem_to_dicts(problem: Problem) -> tuple[tuple[dict[str, Any], ...], tuple[dict[str, Any], ...]]:
    """Convert the declared parameters and the candidates of a problem to dictionaries of plain values."""
    return tuple(map(asdict, problem.declared)), tuple(map(candidate_to_dict, problem.candidates))


def to_json(case: CaseRecord) -> str:
    """Convert a case to JSON; non-finite numbers become NaN and Infinity, which Python's json module reads."""
    return json.dumps({"format": FORMAT, **asdict(case)})


def from_json(text: str) -> CaseRecord:
    """Read a case from the JSON of `to_json`.

    Raises:
        ValueError: The format is another one.
    """
    content = json.loads(text)
    if content.pop("format") != FORMAT:
        raise ValueError(f"not a file of {FORMAT}")
    content["judged"] = tuple(
        RoundRecord(**{**_tuples(r), "fits": tuple(map(fit_from_dict, r["fits"])), "members": tuple(r["members"])})
        for r in content["judged"]
    )
    content["steps"] = tuple(StepRecord(**_tuples(s)) for s in content["steps"])
    content["bases"] = tuple(map(fit_from_dict, content["bases"]))
    content |= {when: fit_from_dict(content[when]) for when in ("before", "after")}
    content |= {key: tuple(map(tuple, content[key])) for key in ("parts", "recordings")}
    content |= {key: tuple(content[key]) for key in ("declared", "candidates", "effects", "why")}
    return CaseRecord(**content)


def fit_from_dict(content: Mapping[str, Any]) -> FitRecord:
    """Make the record of a fit from a dictionary of plain values."""
    inner = content["finished"]
    return FitRecord(**{**_tuples(content), "finished": None if inner is None else fit_from_dict(inner)})


def _tuples(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content with its lists as tuples: JSON has none."""
    return {key: tuple(value) if isinstance(value, list) else value for key, value in content.items()}


def _floats(values: Any) -> tuple[float, ...]:
    return tuple(float(v) for v in values)
