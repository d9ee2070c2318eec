"""Write a case with an undeclared effect: a folder for `neuido diagnose` and a sealed key."""

import contextlib
import hashlib
import math
import re
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from neuido.data.files.parsing import read_yaml
from neuido.data.files.writing import made_folder, new_folder, remove, write_text
from neuido.data.progress import Progress
from neuido.data.undeclared.body_case import SOLVERS, body_case
from neuido.data.undeclared.case import Case
from neuido.data.undeclared.curves import TEST_OUTSIDE, curve_case
from neuido.data.undeclared.driven_bodies import driven_case
from neuido.data.undeclared.guided_tracks import guided_case
from neuido.data.undeclared.random_effects import KINDS, MAX_SEPARATION, MIN_SEPARATION, OUTSIDE, Redraw
from neuido.errors import UserError
from neuido.physics.effects.point_library import POINT_ENTRIES
from neuido.physics.runtime.device import choose_device
from neuido.physics.runtime.limits import check_limit

MEASURED = ("body", "driven", "material_test", "track", "guided")
TRIES = 12
"""Largest number of random draws for a seed."""
SHORTEST_STEP = 6.25e-5
"""The shortest step that a body may be simulated with [s]: grains, half the step for slow losses and for a finer solver."""


def make_sealed_case(seed: int, out: str | Path, *, case: Case, device: str, progress: bool) -> Path:
    """Generate a case as `make_undeclared`, which documents arguments, result and errors."""
    folder = Path(out).expanduser().absolute()
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", folder.name):
        raise UserError(f"out = {out}: the name of the folder must consist of letters, digits, -, _ and dots")
    _check(case)
    key = folder.parent / "keys" / f"{folder.name}.yaml"
    plan = {"seed": int(seed), "options": asdict(case)}
    if folder.exists():
        if key.is_file() and _plan_of(key) == plan and (folder / "README.md").is_file():
            return key
        raise UserError(f"out = {folder} exists and is not the case of seed {seed} with these options: give another folder")
    with contextlib.ExitStack() as undo:
        undo.enter_context(made_folder(key.parent))
        with new_folder(folder) as hidden:
            text = _make(int(seed), hidden, folder.name, case, plan, str(choose_device(device)), progress)
            if folder.exists():
                raise UserError(f"out = {folder} was created by another process in the meantime; nothing was overwritten")
            if not key.exists():
                undo.callback(remove, key)
            write_text(key, text)
        undo.pop_all()
    return key


def _make(seed: int, hidden: Path, name: str, case: Case, plan: dict[str, Any], device: str, progress: bool) -> str:
    """Fill a folder with a case, and return the text of its key."""
    maker = {"body": body_case, "driven": driven_case, "guided": guided_case}.get(case.measured, curve_case)
    with Progress(f"case {name}", unit="simulations", shown=progress) as work:
        for attempt in range(TRIES):
            rng = np.random.default_rng([seed, attempt])
            try:
                write_folder, truth = maker(rng, case, name, device, work.update)
                break
            except Redraw as again:
                reason = str(again)
                work.say(f"drawn again: {reason}")
        else:
            raise UserError(f"seed {seed} gives no usable case in {TRIES} draws (last reason: {reason}): give another seed or kind")
        for row in truth.get("recordings", ()):
            for words in row.get("events", ()):
                work.print(f"note: {row['name']}: {words}")
    sealed = {**truth, "sealed": {**plan, "attempt": attempt, "salt": rng.bytes(16).hex()}}
    text = yaml.safe_dump(sealed, sort_keys=False, default_flow_style=None, width=140)
    write_folder(hidden)
    write_text(hidden / "README.md", _readme(name, text))
    return text


def _check(case: Case) -> None:
    if case.measured not in MEASURED:
        raise UserError(f"measured = {case.measured!r} is unknown: choose from {', '.join(MEASURED)}")
    if case.solver is not None and case.solver not in SOLVERS:
        raise UserError(f"solver = {case.solver!r} is unknown: choose from {', '.join(SOLVERS)}")
    if case.kind is not None and case.kind != "none" and case.measured not in ("driven", "guided"):
        tests = (*(entry.name for entry in POINT_ENTRIES), *TEST_OUTSIDE) if case.measured == "material_test" else ()
        known = (*KINDS, *OUTSIDE, *tests)
        for kind in case.kind.split("+"):
            if kind not in known:
                raise UserError(f"kind = {kind!r} is unknown: choose from none, {', '.join(known)}, or join two by +")
        kinds = case.kind.split("+")
        if len(kinds) > 2 or len(set(kinds)) < len(kinds) or (len(kinds) == 2 and any(k in OUTSIDE for k in kinds)):
            raise UserError(f"kind = {case.kind!r}: give one effect, or two different effects of the library")
    if case.nuisances and case.kind not in (None, "none"):
        raise UserError("nuisances requires kind = none: an effect beside them could not be scored")
    if case.separation is not None and not MIN_SEPARATION <= case.separation <= MAX_SEPARATION:
        raise UserError(
            f"separation = {case.separation}; it must lie in {MIN_SEPARATION:g} to {MAX_SEPARATION:g} standard deviations of the noise"
        )
    if case.particles < 0 or (0 < case.particles < 100) or not (case.seconds == 0 or 0.05 <= case.seconds < math.inf):
        raise UserError(f"particles = {case.particles} must be 0 or at least 100, seconds = {case.seconds} 0 or at least 0.05 s")
    check_limit(case.particles, "NEUIDO_MAX_PARTICLES", f"particles is {case.particles}")
    steps = round(case.seconds / SHORTEST_STEP)
    check_limit(steps, "NEUIDO_MAX_STEPS", f"seconds is {case.seconds:g}, which may take {steps} steps")


def _plan_of(key: Path) -> dict[str, Any]:
    sealed = read_yaml(key).get("sealed", {})
    return {name: sealed.get(name) for name in ("seed", "options")}


def _readme(name: str, key: str) -> str:
    digest = hashlib.sha256(key.encode()).hexdigest()
    return (
        f"# {name}\n\nMeasured data with the declared model. What the model lacks, if anything, is sealed in\n"
        f"`../keys/{name}.yaml`; nothing that diagnoses may read it. The SHA-256 of that file is\n\n    {digest}\n"
    )
