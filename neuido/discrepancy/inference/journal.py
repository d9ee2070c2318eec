"""What a diagnosis has tried, as immutable records: every fit that was judged, in the order of the rounds, without its arrays."""

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
    """A model that was fitted: the declared one with a set of effects, by one method."""

    method: int
    """Setting of the discretisation that its method suggests."""
    effects: tuple[str, ...]
    """Keys of its effects; none for the declared model alone."""
    point: Mapping[str, float]
    names: tuple[str, ...]
    """The parameters that were free."""
    cost: float
    converged: bool
    evaluations: int
    setting: int
    """Setting that the fit was made with; a search may use a quicker one than that of its method."""
    errors: tuple[float, ...]
    """Mean squares of what is left of each part."""
    spread: tuple[float, ...]
    """Mean squares of what the settings differ by there, of each part."""
    alone: tuple[float, ...] | None = None
    """Mean squares of what one setting alone leaves, where that was asked for."""
    finished: "FitRecord | None" = None
    """The fit brought to its end, where that was asked for."""

    @property
    def digest(self) -> str:
        """Identify the model, the method and the place."""
        content = [self.method, sorted(self.effects), sorted(self.point.items())]
        return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16]


@dataclass(frozen=True)
class RoundRecord:
    """What was judged once: the model that it began from, the fits beside it, and what was said of them."""

    method: int
    base: Mapping[str, float]
    errors: tuple[float, ...]
    """Mean squares of what the base leaves of each part."""
    floors: tuple[float, ...]
    """What noise and discretisation would leave after a refit."""
    null: tuple[float, ...]
    """Largest gains of the draws under the null hypothesis."""
    exact_null: tuple[float, ...]
    """The same for noise and nuisances alone, where they were drawn."""
    unfitted: Mapping[str, str]
    fits: tuple[FitRecord, ...]
    p_value: float
    chosen: str | None
    members: tuple[str, ...]
    reasons: Mapping[str, str]
    """Why a candidate was rejected, by key."""


@dataclass(frozen=True)
class StepRecord:
    """A step of the answer: a judged round as it stands at the end, after what later steps made of it."""

    judged: int | None
    """Number of the judged round; none where the declared model was not searched."""
    base: Mapping[str, float]
    errors: tuple[float, ...]
    floors: tuple[float, ...]
    chosen: str | None
    members: tuple[str, ...]
    unsure: bool


@dataclass(frozen=True)
class CaseRecord:
    """All that the decision of one diagnosis rests on."""

    name: str
    method: int
    """Setting of the method that the answer goes by."""
    discretised: bool
    parts: tuple[tuple[int, bool, int, str], ...]
    """Recording, whether it is fitted, rows and name of each part."""
    recordings: tuple[tuple[str, str, int, float, str], ...]
    """Name, role, data, noise and the noise's origin of each recording."""
    declared: tuple[Mapping[str, Any], ...]
    candidates: tuple[Mapping[str, Any], ...]
    bases: tuple[FitRecord, ...]
    """The declared model fitted by each method."""
    judged: tuple[RoundRecord, ...]
    steps: tuple[StepRecord, ...]
    before: FitRecord
    after: FitRecord
    answer: str
    effects: tuple[str, ...]
    why: tuple[str, ...]
    facts: Mapping[str, Any]
    """What else the decision needs: whether the search was cut off, findings of the fitted figures, whether no other setting runs."""
    work: Mapping[str, Mapping[str, float]]
    """What each step ran: simulations, effort and seconds."""


@dataclass(eq=False)
class Journal:
    """Collects the records while a diagnosis runs; shared by its methods."""

    rounds: list[RoundRecord] = field(default_factory=list)
    bases: list[FitRecord] = field(default_factory=list)
    alone: dict[tuple, tuple[float, ...]] = field(default_factory=dict)
    """What one setting alone leaves, by `place`."""

    def judged(
        self,
        method: int,
        result: Round,
        stands: Sequence[tuple[Candidate, Stand]],
        parts: Sequence[Part],
        finished: Mapping[str, Stand],
        exact_null: np.ndarray,
    ) -> int:
        """Add a round with the stands that it was judged with, and return its number."""
        made = [self.fit(method, result.base, c, stand, parts, finished.get(c.key)) for c, stand in stands]
        self.rounds.append(
            RoundRecord(
                method,
                dict(result.base),
                _floats(result.errors),
                _floats(result.floors),
                _floats(result.null),
                _floats(exact_null),
                dict(result.unfitted),
                tuple(made),
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
        """Return the record of a fit with a candidate beside the effects of a base."""
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
        """Return the rounds of an answer."""
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
    """Return what identifies a fit with its errors."""
    return method, tuple(sorted(stand.fit.point.items())), tuple(stand.errors.tolist())


def candidate_of(c: Candidate) -> dict[str, Any]:
    """Return a candidate as plain values."""
    own = {f.name: getattr(c, f.name) for f in fields(c) if f.name not in ("parameters", "starts", "beside")}
    own |= {"sizes": list(c.sizes), "takes": list(c.takes)}
    return {**own, "parameters": [asdict(p) for p in c.parameters], "starts": [dict(s) for s in c.starts], "beside": dict(c.beside)}


def as_candidate(content: Mapping[str, Any]) -> Candidate:
    """Return the candidate of plain values."""
    tuples = {k: tuple(content[k]) for k in ("sizes", "takes")}
    parameters = tuple(Parameter(**p) for p in content["parameters"])
    return Candidate(**{**content, **tuples, "parameters": parameters, "starts": tuple(content["starts"])})


def described(problem: Problem) -> tuple[tuple[dict[str, Any], ...], tuple[dict[str, Any], ...]]:
    """Return the declared parameters and the candidates of a problem as plain values."""
    return tuple(map(asdict, problem.declared)), tuple(map(candidate_of, problem.candidates))


def to_json(case: CaseRecord) -> str:
    """Return a case as JSON; figures that are not finite are written as Python's own reader takes them."""
    return json.dumps({"format": FORMAT, **asdict(case)})


def from_json(text: str) -> CaseRecord:
    """Return the case of JSON that `to_json` wrote."""
    content = json.loads(text)
    if content.pop("format") != FORMAT:
        raise ValueError(f"not a file of {FORMAT}")
    content["judged"] = tuple(
        RoundRecord(**{**_tuples(r), "fits": tuple(map(fit_of, r["fits"])), "members": tuple(r["members"])}) for r in content["judged"]
    )
    content["steps"] = tuple(StepRecord(**_tuples(s)) for s in content["steps"])
    content["bases"] = tuple(map(fit_of, content["bases"]))
    content |= {when: fit_of(content[when]) for when in ("before", "after")}
    content |= {key: tuple(map(tuple, content[key])) for key in ("parts", "recordings")}
    content |= {key: tuple(content[key]) for key in ("declared", "candidates", "effects", "why")}
    return CaseRecord(**content)


def fit_of(content: Mapping[str, Any]) -> FitRecord:
    """Return the record of plain values."""
    inner = content["finished"]
    return FitRecord(**{**_tuples(content), "finished": None if inner is None else fit_of(inner)})


def _tuples(content: Mapping[str, Any]) -> dict[str, Any]:
    return {key: tuple(value) if isinstance(value, list) else value for key, value in content.items()}


def _floats(values: Any) -> tuple[float, ...]:
    return tuple(float(v) for v in values)
