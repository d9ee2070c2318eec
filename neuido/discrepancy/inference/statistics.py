"""Sufficient statistics of fits for the likelihood, small enough to store with each diagnosis.

Take a part of the data with residual r and directions S (smooth patterns), N (nuisances), D (differences between settings) and J (slopes).
A Gaussian density of r with a covariance of noise and these directions depends only on the triangular QR factor of [S N D J r]. This
factor is stored in single precision. Its columns of S and N are stored once for all fits of a method.
"""

import json
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from neuido.data.files.writing import write_arrays
from neuido.discrepancy.inference import directions, discretisation
from neuido.discrepancy.inference.floors import Floor, score
from neuido.discrepancy.inference.journal import CaseRecord, FitRecord, Journal, fit_from_dict, from_json, to_json
from neuido.discrepancy.inference.laboratory import Laboratory
from neuido.errors import UserError

MOST = 24
"""Most fits whose statistics are kept: the declared model by each method, and the best fits of sets of effects by each method."""
STEP = 0.1
"""Difference step of the slopes, in typical steps of a parameter."""


@dataclass(frozen=True, eq=False)
class PartStatistics:
    """A part of the data in an orthonormal basis (of size k) of the directions and the residual, which holds all of the residual."""

    rows: int
    """Number of data."""
    noise: float
    """Standard deviation of the noise."""
    smooth: np.ndarray
    """(k, s), smooth patterns; their sum has a mean square of one over all rows."""
    nuisances: np.ndarray
    """(k, n), change by one prior standard deviation of each nuisance."""
    settings: np.ndarray
    """(k, d), differences between the other settings and the one in use."""
    slopes: np.ndarray
    """(k, p), derivatives by the coordinates of the free parameters."""
    residual: np.ndarray
    """(k,), predicted minus measured."""


@dataclass(frozen=True, eq=False)
class FitStatistics:
    """A fit with the statistics of all parts."""

    record: FitRecord
    """The fit."""
    parts: tuple[PartStatistics, ...]
    """Statistics of each part, in the order of the parts of the case."""


def best_fits(journal: Journal, ends: Sequence[FitRecord] = (), most: int = MOST) -> list[FitRecord]:
    """Choose the fits to keep: the fits of the declared model, and the best fit of each set of effects by each method.

    Args:
        journal: Records of the diagnosis.
        ends: Final fits of the answer; their sets of effects are kept first.
        most: Largest number of fits.
    """
    best: dict[tuple, FitRecord] = {}
    judged = [fit.finished or fit for r in journal.rounds for fit in r.fits]
    for fit in (*ends, *judged):
        if fit.effects and np.isfinite(fit.errors).all():
            key = fit.method, tuple(sorted(fit.effects))
            if key not in best or score(np.array(fit.errors)) < score(np.array(best[key].errors)):
                best[key] = fit
    declared = {fit.digest: fit for fit in (*journal.bases, *(fit for fit in ends if not fit.effects))}
    first = {end.method: tuple(sorted(end.effects)) for end in ends}
    ranked = sorted(best.items(), key=lambda item: (first.get(item[0][0]) != item[0][1], score(np.array(item[1].errors))))
    return [*declared.values(), *(fit for _, fit in ranked[: max(most - len(declared), 0)])]


def statistics_of(
    laboratories: Sequence[Laboratory], floors: Sequence[Floor], journal: Journal, ends: Sequence[FitRecord] = ()
) -> dict[str, np.ndarray]:
    """Compute the statistics of the best fits, as named arrays for `write_fits`.

    Args:
        laboratories: The methods.
        floors: Floor of each method where the fit of the declared model ended; its nuisances are used for all fits.
        journal: Records of the diagnosis.
        ends: Final fits of the answer.
    """
    arrays: dict[str, np.ndarray] = {}
    listed, chosen = [], best_fits(journal, ends)
    for lab, floor in zip(laboratories, floors, strict=True):
        own = [fit for fit in chosen if fit.method == lab.own]
        with lab.under(lab.own):
            discretisation.prefetch(lab, [fit.point for fit in own])
            _prefetch_slopes(lab, own)
            common = _common(lab, floor)
            for i, (part, (_, factor, sizes)) in enumerate(zip(lab.parts, common, strict=True)):
                arrays[f"common-{lab.own}-{i}"] = factor.astype(np.float32)
                arrays[f"sizes-{lab.own}-{i}"] = np.array([*sizes, int(part.rows.sum())])
            for fit in own:
                columns = _columns(lab, fit, floor)
                if columns is None:
                    continue
                k = len(listed)
                listed.append(json.dumps(asdict(replace(fit, finished=None, alone=None))))
                for i, (part, (basis, *_)) in enumerate(zip(lab.parts, common, strict=True)):
                    own_columns = columns[part.recording][part.rows]
                    inside = basis.T @ own_columns
                    arrays[f"inside-{k}-{i}"] = inside.astype(np.float32)
                    arrays[f"outside-{k}-{i}"] = np.linalg.qr(own_columns - basis @ inside, mode="r").astype(np.float32)
    noise = [laboratories[0].noise_of(p.recording) for p in laboratories[0].parts] if laboratories else []
    return arrays | {"fits": np.array(listed), "noise": np.array(noise), "fitted": np.array(laboratories[0].fitted if laboratories else [])}


def read(arrays: Mapping[str, np.ndarray]) -> list[FitStatistics]:
    """Return the fits from the arrays of `statistics_of`."""
    out = []
    for k, text in enumerate(arrays["fits"]):
        record = fit_from_dict(json.loads(str(text)))
        parts = []
        for i, noise in enumerate(arrays["noise"]):
            common = arrays[f"common-{record.method}-{i}"].astype(float)
            smooth, nuisances, rows = (int(v) for v in arrays[f"sizes-{record.method}-{i}"])
            inside, outside = (arrays[f"{name}-{k}-{i}"].astype(float) for name in ("inside", "outside"))
            below = np.concatenate([common, np.zeros((len(outside), common.shape[1]))])
            own = np.concatenate([inside, outside])
            free = len(record.names)
            settings = own.shape[1] - free - 1
            parts.append(
                PartStatistics(
                    rows,
                    float(noise),
                    below[:, :smooth],
                    below[:, smooth : smooth + nuisances],
                    own[:, :settings],
                    own[:, settings:-1],
                    own[:, -1],
                )
            )
        out.append(FitStatistics(record, tuple(parts)))
    return out


def write_fits(path: Path, case: CaseRecord, arrays: Mapping[str, np.ndarray] | None) -> None:
    """Write a case, and the statistics of its fits if given, to one compressed NumPy file (.npz)."""
    text = np.frombuffer(to_json(case).encode(), np.uint8)
    write_arrays(path, {"case": text, **(arrays or {})})


def read_fits(path: Path) -> tuple[CaseRecord, list[FitStatistics]]:
    """Read the case and the statistics of its fits from a file of `write_fits`; there may be no statistics.

    Raises:
        UserError: The file cannot be read, or was not written by `write_fits`.
    """
    try:
        with np.load(path, allow_pickle=False) as arrays:
            case = from_json(arrays["case"].tobytes().decode())
            return case, read(arrays) if "fits" in arrays else []
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise UserError(f"{path} holds no stored fits: {error}") from error


def _common(lab: Laboratory, floor: Floor) -> list[tuple[np.ndarray, np.ndarray, tuple[int, int]]]:
    """Factorise the smooth patterns and nuisances of each part.

    Returns:
        For each part the orthonormal basis (rows, k), the triangular factor (k, s + n), and the numbers s of patterns and n of nuisances.
    """
    out = []
    for part in lab.parts:
        smooth = lab.problem.directions(part.recording)[part.rows]
        nuisances = floor.nuisances.get(part.recording, np.empty((len(part.rows), 0)))[part.rows]
        basis, factor = np.linalg.qr(np.concatenate([smooth, nuisances], axis=1))
        out.append((basis, factor, (smooth.shape[1], nuisances.shape[1])))
    return out


def _columns(lab: Laboratory, fit: FitRecord, floor: Floor) -> dict[int, np.ndarray] | None:
    """Return the columns [D J r] of each recording at the end of a fit; None if the model or a slope does not run there."""
    parameters = [lab.problem.parameter(name) for name in fit.names]
    recordings = lab.scored_recordings
    there = discretisation.floor_at(lab, fit.point, like=floor)
    try:
        slopes = directions.slopes(lab, parameters, fit.point, recordings, step=STEP)
    except UserError:
        return None
    out = {}
    for n in recordings:
        residual = lab.residual(fit.point, n)
        out[n] = np.concatenate([there.differences[n], slopes[n], residual[:, None]], axis=1)
    return out if all(np.isfinite(c).all() for c in out.values()) else None


def _prefetch_slopes(lab: Laboratory, fits: Sequence[FitRecord]) -> None:
    """Run the simulations for the slopes of all fits in one launch, and keep them in the memo."""
    points = []
    for fit in fits:
        points += directions.step_points([lab.problem.parameter(name) for name in fit.names], fit.point, STEP)[0]
    with lab.memo.during("slopes"):
        lab.predicted(points, lab.scored_recordings)
