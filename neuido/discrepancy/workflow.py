"""The steps of a diagnosis, from measured data (a folder, objects or arrays) to the folder of results."""

import hashlib
import json
import math
import os
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuido.data.files.output_folder import held_folder
from neuido.data.files.renamed_options import renamed_arguments
from neuido.data.files.writing import check_writable, made_folder, make_real_folder
from neuido.discrepancy.diagnosis_log import Log
from neuido.discrepancy.report.diagnosis import Diagnosis
from neuido.errors import UserError

if TYPE_CHECKING:
    from neuido.data.measured.experiment import Experiment
    from neuido.data.measured.material_test import MaterialTests
    from neuido.data.measured.plane_experiment import PlaneExperiment
    from neuido.data.measured.track import Tracks
    from neuido.discrepancy.own_effects import OwnEffect
    from neuido.discrepancy.problems.body import BodyProblem
    from neuido.discrepancy.problems.problem import Problem

DATA = ("auto", "points", "video")
SOLVERS = ("both", "material_points", "finite_elements")
EFFORTS = {"quick": 1_000.0, "normal": 10_000.0, "thorough": 100_000.0}
"""Work of a search, in simulations of all recordings with the declared model.

In thirty blind cases, the 24 searches that were completed simulated each recording 35 to 10,900 times (median 1,200). A simulation cost two
thirds of one with the declared model.
"""
KINDS = {"experiment.yaml": "experiment", "test.yaml": "material test", "track.yaml": "track", "plane.yaml": "plane specimen"}


@renamed_arguments(most="max_effects")
def diagnose(
    source: "str | os.PathLike | Experiment | MaterialTests | PlaneExperiment | Tracks | Mapping[str, Mapping[str, Any]]",
    *,
    out: str | os.PathLike | None = None,
    model: str | os.PathLike | Mapping[str, Any] | None = None,
    law: str | os.PathLike | None = None,
    data: str = "auto",
    effects: str | Sequence[str] | None = None,
    candidates: "Sequence[OwnEffect]" = (),
    scene: Mapping[str, Any] | None = None,
    solver: str = "both",
    draws: int = 199,
    seed: int = 0,
    max_effects: int = 3,
    effort: str = "normal",
    minutes: float = 15.0,
    device: str = "auto",
    resume: bool = True,
    statistics: bool = False,
    progress: bool = False,
) -> Diagnosis:
    """Find the physical effect that a declared model lacks, from measured motion, and add it.

    Args:
        source: Measured data: a folder with experiment.yaml, test.yaml, track.yaml or plane.yaml, or what `read_experiment`,
            `read_material_tests`, `read_tracks` or `read_plane_experiment` returned, or arrays: of each recording its columns
            (`arrays.write_arrays` says which), with `model`.
        out: Folder for the results. None: a temporary folder, removed with the diagnosis.
        model: Model in place of the folder's own: a file, for example an earlier model_after.yaml, or its content; that of arrays. Not of
            data that are read already.
        law: Neural law of `neuido predict` in place of the elasticity and plasticity of an experiment; a factor on its stress is fitted.
        data: Of an experiment: points (tracked ones), video (silhouettes), or auto: points where every recording has them.
        effects: Names of the effects to consider, as a list or with commas. None: all that the data could show.
        candidates: Effects of one's own to consider beside them.
        scene: Of bodies that are given as arrays: the keys of `scene` and `discretisation` of the format together.
        solver: What may predict the motion of a body: material_points, finite_elements, or both, so that the data choose.
        draws: Draws of the parametric bootstrap, at least 19; p-values come in steps of 1 / (draws + 1).
        seed: Seed of the draws.
        max_effects: Largest number of effects that may be added, 1 to 3.
        effort: Work of the search for each body: quick, normal or thorough (`EFFORTS`). A search that ends early names what it left out,
            and the same call with more effort continues.
        minutes: Time after which the search of each body is stopped [min]; 0: none. The answer is `unfinished` then. On a CPU the time that
            other processes take does not count.
        device: auto, cpu, cuda or cuda:N.
        resume: Continue from the predictions that an interrupted run left in `out`/.work. Folders only.
        statistics: Keep in `out`/fits what the decision rests on, to be decided again without simulations; this takes some more of them.
        progress: Show progress on stderr.

    Returns:
        The diagnosis, read from the folder of results.

    Raises:
        UserError: Data that are in none of the formats, or an option out of range.
    """
    begun = time.monotonic()
    if draws < 19:
        raise UserError(f"draws = {draws} is too few for a level of 5 %: give at least 19")
    if not 1 <= max_effects <= 3:
        raise UserError(f"max_effects = {max_effects} must be 1, 2 or 3")
    if effort not in EFFORTS:
        raise UserError(f"effort = {effort!r} is not known; use {', '.join(EFFORTS)}")
    if not minutes >= 0:
        raise UserError(f"minutes = {minutes} must not be negative; 0 sets no limit")
    arrays = isinstance(source, Mapping)
    given_place = tempfile.TemporaryDirectory(prefix="neuido-arrays-") if arrays else None
    if given_place is not None:
        from neuido.discrepancy.arrays import write_arrays

        source, model = write_arrays(source, model, Path(given_place.name) / "arrays", scene=scene), None
    elif scene is not None:
        raise UserError("scene is for bodies that are given as arrays: a folder has its own")
    folder = os.fspath(source) if isinstance(source, str | os.PathLike) else None
    kind, place = ("", Path()) if folder is None else kind_of(folder)
    if out is not None:
        check_writable(Path(out).expanduser())

    from neuido.discrepancy import store
    from neuido.discrepancy.inference.search.attribution import diagnose as infer
    from neuido.discrepancy.inference.statistics import write_fits
    from neuido.discrepancy.own_effects import with_own_effects
    from neuido.discrepancy.report import answer

    chosen = choose_device(device)
    if folder is None:
        kind, problems = problems_of_data(source, chosen, model=model, law=law, data=data)
    else:
        problems = problems_of(kind, place, model, chosen, law=law, data=data)
    names = effects if effects is None or isinstance(effects, str) else ",".join(effects)
    problems = [with_own_effects(restricted(solved_by(p, solver), names), candidates) for p in problems]
    for problem in problems:
        if problem.margin({}, problem.solvers[0]) < 0.0:  # before anything is written
            raise UserError(problem.refusal(problem.solvers[0]))
    temporary = tempfile.TemporaryDirectory(prefix="neuido-diagnosis-") if out is None else None
    target = Path(temporary.name if temporary else out or "").expanduser()
    given = {"model": hash_of(model), "law": hash_of(law)}
    options = {"effects": names, "draws": draws, "seed": seed, "max_effects": max_effects, "device": chosen, "data": data}
    options |= given | {"solver": solver, "version": store.code_digest()}
    plan = "read-data" if folder is None else store.plan_of(place, options, out=target)
    untouched = not target.is_dir() or not any(target.iterdir())
    with made_folder(target), held_folder(target):
        resumes = resume and folder is not None and not arrays and not candidates  # functions of candidates cannot be hashed
        outdated = store.outdated(target, plan) if resumes else []
        work = store.workplace(target, plan, resume=resumes)
        if not any(work.iterdir()):  # a resumed run keeps its log
            (target / "log.csv").unlink(missing_ok=True)
        if outdated:
            print(f"{target / '.work'}: stored predictions of other data, options or code are ignored", file=sys.stderr)
        found = []
        with Log(target / "log.csv", shown=progress, begun=begun) as log:
            for i, problem in enumerate(problems):
                started = time.monotonic()
                cached = store.CachedProblem(problem, work / str(i), tick=log.tick)
                seconds = 60.0 * minutes or math.inf
                log.begin(problem.name if len(problems) > 1 else "", seconds)
                log(f"fitting the declared model ({kind}, {len(problem.candidates)} effects to consider)")
                try:
                    clock = store.own_clock() if chosen == "cpu" else time.monotonic
                    limits = {"most": max_effects, "passes": EFFORTS[effort], "seconds": seconds, "clock": clock}
                    own = infer(cached, draws=draws, seed=seed, tell=log, statistics=statistics, **limits)
                except UserError:
                    if untouched:
                        _forget(target)
                    raise
                found.append((own, time.monotonic() - started))
                if statistics:
                    write_fits(make_real_folder(target / "fits", "the folder of fits") / f"{i}.npz", own.case, own.statistics)
            log.begin("", math.inf)
            answer.write(target, found, kind=kind, device=chosen, seed=seed, tell=log)
            if not any(own.left_out or own.budget.cut for own, _ in found):  # else a call with more effort continues
                store.clear(target)
            for own, _ in found:
                log.work(own.work)
            log("written")
    if given_place is not None:
        given_place.cleanup()
    return Diagnosis.read(target, keep=temporary)


def _forget(target: Path) -> None:
    """Remove the files of a diagnosis that stopped with an error."""
    from neuido.discrepancy import store

    store.clear(target)
    (target / "log.csv").unlink(missing_ok=True)


def hash_of(given: str | os.PathLike | Mapping[str, Any] | None) -> str | None:
    """Return a hash of the content of a file or mapping; None stays None."""
    if given is None:
        return None
    if isinstance(given, Mapping):
        return hashlib.sha256(json.dumps(given, sort_keys=True, default=str).encode()).hexdigest()
    return hashlib.sha256(Path(given).expanduser().read_bytes()).hexdigest()


def kind_of(folder: str) -> tuple[str, Path]:
    """Return the kind of data in a folder (a value of `KINDS`) and its path.

    Raises:
        UserError: The folder is missing, or it contains none or several of the files.
    """
    given = Path(folder).expanduser()
    if given.is_file() and given.name in KINDS:
        given = given.parent
    if not given.is_dir():
        raise UserError(f"folder = {folder}: there is no such folder")
    there = [name for name in KINDS if (given / name).is_file()]
    if len(there) != 1:
        what = f"both {there[0]} and {there[1]}" if there else f"none of {', '.join(KINDS)}"
        raise UserError(f"folder = {folder} holds {what}: a diagnosis takes one of them")
    return KINDS[there[0]], given


def problems_of(
    kind: str,
    folder: Path,
    model: str | os.PathLike | Mapping[str, Any] | None,
    device: str,
    *,
    law: str | os.PathLike | None = None,
    data: str = "auto",
) -> "Sequence[Problem]":
    """Read a folder and return its problems: one, or one for each body of a track folder.

    Raises:
        UserError: The folder, the file of the model or the law is invalid, or `law` or `data` is given for other data than experiments.
    """
    if data not in DATA:
        raise UserError(f"data = {data!r} is not known; use {', '.join(DATA)}")
    from neuido.discrepancy.problems.declared_model import read_model_file, with_law

    given = dict(model) if isinstance(model, Mapping) else None if model is None else read_model_file(os.fspath(model))
    if kind == "experiment":
        from neuido.data.measured.experiment import read_experiment

        found = read_experiment(folder, model=given)
        return [experiment_problem(found if law is None else with_law(found, os.fspath(law)), data, device)]
    if law is not None or data != "auto":
        raise UserError(f"{'law' if law is not None else 'data'} is for experiments, and {folder} is a {kind}: leave it out")
    if kind == "material test":
        from neuido.data.measured.material_test import read_material_tests
        from neuido.discrepancy.problems.specimens.material import MaterialProblem

        return [MaterialProblem(read_material_tests(folder, model=given))]
    if kind == "plane specimen":
        from neuido.data.measured.plane_experiment import read_plane_experiment
        from neuido.discrepancy.problems.planes.plane_problem import PlaneProblem

        return [PlaneProblem(read_plane_experiment(folder, model=given))]
    from neuido.data.measured.track import read_tracks
    from neuido.discrepancy.problems.tracks.track_problem import TrackProblem, track_problems

    if given is None or set(given) != {"bodies"}:
        return track_problems(read_tracks(folder, model=given))
    bodies = read_tracks(folder).bodies
    if not isinstance(given["bodies"], dict) or set(given["bodies"]) != set(bodies):
        raise UserError(f"model = {model}: bodies must name {', '.join(bodies)}")
    return [TrackProblem(read_tracks(folder, model=given["bodies"][body]), body) for body in bodies]


def problems_of_data(
    source: Any, device: str, *, model: Any = None, law: str | os.PathLike | None = None, data: str = "auto"
) -> "tuple[str, Sequence[Problem]]":
    """Return kind and problems of data that are read already: one problem, or one for each body of tracks.

    Raises:
        UserError: The object is none of the kinds of data, or it does not take an option that is given.
    """
    from neuido.data.measured.experiment import Experiment
    from neuido.data.measured.material_test import MaterialTests
    from neuido.data.measured.plane_experiment import PlaneExperiment
    from neuido.data.measured.track import Tracks

    if not isinstance(source, Experiment | MaterialTests | PlaneExperiment | Tracks):
        raise UserError(
            f"a diagnosis takes a folder, an Experiment, MaterialTests, a PlaneExperiment or Tracks, not {type(source).__name__}"
        )
    if model is not None:
        raise UserError("model replaces that of a folder: give the folder, or give the model to the function that reads the data")
    if data not in DATA:
        raise UserError(f"data = {data!r} is not known; use {', '.join(DATA)}")
    if isinstance(source, Experiment):
        from neuido.discrepancy.problems.declared_model import with_law

        return "experiment", [experiment_problem(source if law is None else with_law(source, os.fspath(law)), data, device)]
    if law is not None or data != "auto":
        raise UserError(f"{'law' if law is not None else 'data'} is for experiments, not {type(source).__name__}: leave it out")
    if isinstance(source, MaterialTests):
        from neuido.discrepancy.problems.specimens.material import MaterialProblem

        return "material test", [MaterialProblem(source)]
    if isinstance(source, PlaneExperiment):
        from neuido.discrepancy.problems.planes.plane_problem import PlaneProblem

        return "plane specimen", [PlaneProblem(source)]
    from neuido.discrepancy.problems.tracks.track_problem import track_problems

    return "track", track_problems(source)


def experiment_problem(experiment: "Experiment", data: str, device: str) -> "BodyProblem":
    """Return the problem of an experiment, with its tracked points or its videos as data.

    `data` is `points`, `video` or `auto` (points where every recording has them, or where no video is there).

    Raises:
        UserError: A recording lacks the data that are asked for.
    """
    from neuido.discrepancy.problems.body import body_problem

    if data == "auto":
        tracked = [r.x is not None for r in experiment.recordings]
        data = "points" if all(tracked) or all(r.video is None for r in experiment.recordings) else "video"
    if data == "points":
        if any(r.clamps for r in experiment.recordings):
            from neuido.discrepancy.problems.clamped import clamped_problem

            return clamped_problem(experiment, device=device)
        return body_problem(experiment, device=device)
    if any(r.clamps for r in experiment.recordings):
        raise UserError("data = video: clamps with a name need tracked points; leave it out")
    from neuido.discrepancy.problems.video import video_problem

    return video_problem(experiment, device=device)


def solved_by(problem: "Problem", solver: str) -> "Problem":
    """Return the problem with one simulation method, or unchanged for `both`.

    Raises:
        UserError: The method is unknown, or the problem is not discretised.
    """
    if solver not in SOLVERS:
        raise UserError(f"solver = {solver!r}: choose from {', '.join(SOLVERS)}")
    if solver == "both":
        return problem
    from neuido.discrepancy.problems.rollouts import BodyRollouts
    from neuido.discrepancy.problems.settings import SETTINGS

    if not isinstance(problem, BodyRollouts):
        raise UserError(f"solver = {solver}: {problem.name} is no body that moves, which these methods simulate; leave it out")

    own = tuple(i for i in problem.solvers if SETTINGS[i].solver == solver)
    if not own:
        raise UserError(f"solver = {solver}: it moves no clamps and has no forces on them; leave it out")
    if solver == "material_points":  # these settings are the first ones
        object.__setattr__(problem, "settings", sum(s.solver == solver for s in SETTINGS))
    object.__setattr__(problem, "solvers", own)
    return problem


def restricted(problem: "Problem", effects: str | None) -> "Problem":
    """Return the problem with only the named candidates (separated by commas); None keeps all.

    Raises:
        UserError: A name is no effect, or the problem can show none of them.
    """
    if effects is None:
        return problem
    from neuido.physics.effects.library import LIBRARY

    names = [name.strip() for name in effects.split(",") if name.strip()]
    known = [entry.name for entry in LIBRARY]
    for name in names:
        if name not in known:
            raise UserError(f"effects: {name!r} is not known; choose from {', '.join(known)}")
    left = tuple(c for c in problem.candidates if c.name in names)
    if not left:
        able = dict.fromkeys(c.name for c in problem.candidates)
        raise UserError(f"effects = {effects}: {problem.name} can show none of them; it can show {', '.join(able)}")
    object.__setattr__(problem, "candidates", left)
    return problem


def choose_device(device: str) -> str:
    """Return the name of the device; `auto` becomes `cuda` where there is one, else `cpu`.

    Raises:
        UserError: The name is unknown, or there is no CUDA device.
    """
    import torch

    if device not in ("auto", "cpu", "cuda") and not device.startswith("cuda:"):
        raise UserError(f"device = {device!r} is not known; use auto, cpu or cuda")
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise UserError(f"device = {device}: torch finds no CUDA device here; use cpu")
    return ("cuda" if torch.cuda.is_available() else "cpu") if device == "auto" else device
