"""Material tests: measured stress over stretch of one material, in the folder format `neuido-material-test/1`."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from neuido.data.files.values import check_keys, file_name, mapping, number, vector
from neuido.data.measured.columns import (
    check_increasing,
    errors_of,
    read_columns,
    read_effects,
    read_entries,
    read_free,
    read_header,
    read_role,
    read_text,
)
from neuido.data.measured.experiment import read_model
from neuido.data.measured.plausibility import check_density, check_order, check_rows, check_stress, check_stretches
from neuido.errors import UserError
from neuido.physics.effects.point_library import FLUID, POINT_ENTRIES
from neuido.types import Vector

FORMAT = "neuido-material-test/1"
STRAINS = {"stretch": "log_strain", "stretch_1": "log_strain_1", "stretch_2": "log_strain_2"}
STRESSES = {"nominal_stress": "true_stress", "nominal_stress_1": "true_stress_1", "nominal_stress_2": "true_stress_2"}
MODES = {  # mode: prescribed columns, measured columns
    "uniaxial": (("stretch",), ("nominal_stress",)),
    "equibiaxial": (("stretch",), ("nominal_stress",)),
    "pure_shear": (("stretch",), ("nominal_stress",)),
    "biaxial": (("stretch_1", "stretch_2"), ("nominal_stress_1", "nominal_stress_2")),
    "simple_shear": (("shear",), ("shear_stress",)),
    "oscillation": (("angular_frequency",), ("storage_modulus", "loss_modulus")),
    "flow_curve": (("shear_rate",), ("shear_stress",)),
}
CURVES = ("oscillation", "flow_curve")
"""Modes that are no history of strain. Their values span decades, so their logarithms are compared."""
CONTROLS = ("strain", "stress")
"""What the machine prescribes; with `stress`, as in a creep test, the strain is what was measured."""
EFFECTS = (
    "viscosity_shear", "viscosity_bulk", "maxwell", "hysteresis", "strain_stiffening", "second_invariant", "tension_compression", "fibre",
    "yield", "hardening", "softening", "kinematic_hardening", "rate_yield", "stiffness_change",
    *(entry.name for entry in POINT_ENTRIES if entry.name not in FLUID),
)  # fmt: skip
"""Effects of the library that act on the law of a solid; the others need a body, or a fluid (`FLUID`)."""


@dataclass(frozen=True, eq=False)
class MaterialTest:
    """One material test of one specimen, with n rows."""

    name: str
    role: str
    """`fit` or `held_out`; held-out tests are scored but never fitted."""
    mode: str
    """One of `MODES`."""
    path: np.ndarray
    """Stretches [-], amount of shear [-], angular frequency [rad/s] or shear rate [1/s], (n, 1) or (n, 2) float64."""
    stress: np.ndarray
    """Stress, or storage and loss modulus [Pa], (n, 1) or (n, 2) float64."""
    true_stress: bool
    """Whether `stress` is the Cauchy stress; otherwise it is the nominal stress."""
    file: Path
    columns: tuple[str, ...]
    """Titles of the columns that were read."""
    rows: range
    """Range of the data rows of the file that were read."""
    time: np.ndarray | None = None
    """Times [s] (n,), increasing; None: a quasi-static path in the order of the rows."""
    direction: Vector = (1.0, 0.0, 0.0)
    """Loading axis in the frame of the material, a unit vector."""
    control: str = "strain"
    """One of `CONTROLS`."""
    periodic: bool = False
    """Whether the rows are one period, without its end, of a path that was repeated until the stress repeated too."""
    noise: float | None = None
    """Stated standard deviation of the independent noise of what was measured; None: to be estimated."""

    @property
    def measured(self) -> np.ndarray:
        """What was measured, (n,) or (2 n,): stress [Pa], stretch or shear [-], or the logarithms of a curve's values."""
        if self.mode in CURVES:
            return np.log(self.stress).reshape(-1)
        return (self.path if self.control == "stress" else self.stress).reshape(-1)

    @property
    def unit(self) -> str:
        """Unit of `measured`."""
        return "1" if self.mode in CURVES or self.control == "stress" else "Pa"


@dataclass(frozen=True, eq=False)
class MaterialTests:
    """All material tests of one material."""

    name: str
    folder: Path
    model: dict[str, Any]
    """The declared model: density [kg/m^3]; elasticity and plasticity (as for `physics.laws.material`), or of a fluid `flow`."""
    free: tuple[str, ...]
    """The parameters of the model to fit; all others are taken as exact."""
    incompressible: bool
    """Whether the material is incompressible, so that a pressure makes the lateral stress zero."""
    effects: dict[str, float]
    """Effects of the declared model by flat names, for example {"strain_stiffening.k": 0.01}."""
    tests: tuple[MaterialTest, ...]

    @property
    def fluid(self) -> bool:
        """Whether the material is a fluid, with flow curves alone."""
        return "flow" in self.model

    def of(self, role: str) -> tuple[MaterialTest, ...]:
        """Return the tests with this role."""
        return tuple(test for test in self.tests if test.role == role)

    def histories(self) -> tuple[tuple[int, ...], ...]:
        """Group the tests into loading histories; return the indices of the tests of each history, in order.

        Tests form one history if they have the same file, columns, mode, direction and control, and their row ranges adjoin. The later
        test then starts in the final state of the earlier one. Every other test starts with a virgin specimen, and so does each
        oscillation and each periodic path.
        """

        def specimen(test: MaterialTest) -> tuple:
            return test.file, test.columns, test.mode, test.direction, test.control

        after: dict[int, int] = {}
        for i, test in enumerate(self.tests):
            for j, later in enumerate(self.tests):
                alone = test.mode == "oscillation" or test.periodic or later.periodic
                if not alone and specimen(test) == specimen(later) and test.rows.stop == later.rows.start and j not in after.values():
                    after[i] = j
                    break
        chains = []
        for i in range(len(self.tests)):
            if i not in after.values():
                chain = [i]
                while chain[-1] in after:
                    chain.append(after[chain[-1]])
                chains.append(tuple(chain))
        return tuple(chains)


def read_material_tests(path: str | os.PathLike, *, model: Mapping[str, Any] | None = None) -> MaterialTests:
    """Read a folder of material tests, or its `test.yaml`.

    Args:
        path: The folder or the file.
        model: Replaces the key `model` of the file.

    Raises:
        UserError: A key, mode, law, column or file is unknown or missing, a value is a NaN, a stretch is not positive, times do not
            increase, or the values are implausible for their unit. The message names the file and the key.
    """
    file, content = read_header(Path(path), "test.yaml", FORMAT)
    folder = file.parent
    with errors_of(file):
        check_keys(content, "the file", ("format", "name", "model", "tests"))
        name = read_text(content["name"], "name")
        given = mapping(content["model"] if model is None else model, "model")
        incompressible = given.pop("incompressible", False)
        if not isinstance(incompressible, bool):
            raise UserError(f"model.incompressible must be true or false, got {incompressible!r}")
        fluid = "flow" in given
        effects = read_effects(given.pop("effects", None), "model.effects", known=FLUID if fluid else EFFECTS)
        declared, free = _read_fluid(given) if fluid else read_model(given)
        tests = read_entries(content["tests"], "tests", "test", lambda entry, where: _test(entry, where, folder))
        if not any(test.role == "fit" for test in tests):
            raise UserError("tests has no entry with role fit: give at least one")
        _check_kinds(tests, fluid)
        _check(tests, declared)
        if incompressible and not fluid and declared["plasticity"]["law"] == "drucker_prager":
            raise UserError("model.incompressible: drucker_prager depends on the pressure, which is then unknown: set it to false")
    return MaterialTests(name, folder, declared, free, incompressible, effects, tests)


def _test(entry: Any, where: str, folder: Path) -> MaterialTest:
    optional = ("scale", "rows", "direction", "control", "periodic", "noise")
    check_keys(entry, where, ("name", "file", "mode", "columns", "role", *optional), optional)
    name = file_name(entry["name"], f"{where}.name")
    where = f"{where} ({name})"
    if not isinstance(entry["mode"], str) or entry["mode"] not in MODES:
        raise UserError(f"{where}.mode = {entry['mode']!r} is unknown: choose from {', '.join(MODES)}")
    role = read_role(entry["role"], where)
    path_keys, stress_keys = MODES[entry["mode"]]
    columns = mapping(entry["columns"], f"{where}.columns")
    path_keys, stress_keys = _choose(columns, path_keys, STRAINS, where), _choose(columns, stress_keys, STRESSES, where)
    check_keys(columns, f"{where}.columns", (*path_keys, *stress_keys, "time"), ("time",))
    scale = mapping(entry.get("scale", {}), f"{where}.scale")
    for key, factor in scale.items():
        if key not in columns:
            raise UserError(f"unknown key {key!r} in {where}.scale; it takes {', '.join(columns)}")
        stress = key in stress_keys
        scale[key] = number(factor, f"{where}.scale.{key}") if stress and factor else number(factor, f"{where}.scale.{key}", above=0.0)
    direction = entry.get("direction", [1, 0, 0])
    direction = np.array(vector(direction, f"{where}.direction"))
    if not np.linalg.norm(direction) > 0:
        raise UserError(f"{where}.direction must not be zero")
    control, periodic, noise = entry.get("control", "strain"), entry.get("periodic", False), entry.get("noise")
    curve = entry["mode"] in CURVES
    if control not in CONTROLS or (control == "stress" and (curve or entry["mode"] == "biaxial")):
        raise UserError(f"{where}.control = {control!r} does not suit {entry['mode']}: choose from strain, or stress with one loading axis")
    if not isinstance(periodic, bool) or (periodic and (curve or control == "stress" or "time" not in columns)):
        raise UserError(f"{where}.periodic = {periodic!r} must be true or false, and takes a history of strain with times")
    noise = None if noise is None else number(noise, f"{where}.noise", above=0.0)
    data, rows = read_columns(folder, entry, where, scale=scale)
    path = np.stack([data[key] for key in path_keys], 1)
    if path_keys[0].startswith("log_strain"):
        path = np.exp(path)
    stress = np.stack([data[key] for key in stress_keys], 1)
    if entry["mode"] != "simple_shear" and not ((path > 0).all() and np.isfinite(path).all()):
        bad = path[~((path > 0) & np.isfinite(path))][0]
        what = {"oscillation": "angular frequencies", "flow_curve": "shear rates"}.get(entry["mode"], "stretches")
        raise UserError(f"{where}: {what} must be positive and finite, got {bad:g}")
    if curve and not (stress > 0).all():
        raise UserError(f"{where}: the values of a curve must be positive, got {stress[~(stress > 0)][0]:g} Pa: leave such rows out (rows)")
    return MaterialTest(
        name=name,
        role=role,
        mode=entry["mode"],
        path=path,
        stress=stress,
        true_stress=stress_keys[0].startswith("true"),
        file=folder / entry["file"],
        columns=tuple(columns.values()),
        rows=rows,
        time=check_increasing(data["time"], where) if "time" in data else None,
        direction=tuple((direction / np.linalg.norm(direction)).tolist()),
        control=control,
        periodic=periodic,
        noise=noise,
    )


def _read_fluid(given: dict[str, Any]) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Validate the declared model of a fluid; return it with the names of its free parameters."""
    check_keys(given, "model", ("density", "flow", "free"), ("free",))
    flow = mapping(given["flow"], "model.flow")
    check_keys(flow, "model.flow", ("law", "viscosity"))
    if flow["law"] != "newtonian":
        raise UserError(f"model.flow.law = {flow['law']!r} is unknown: use newtonian; what else the fluid does is an effect")
    density = number(given["density"], "model.density", above=0.0)
    check_density(density)
    viscosity = number(flow["viscosity"], "model.flow.viscosity", above=0.0)
    free = read_free(given.get("free", []), ("density", "viscosity"))
    return {"density": density, "flow": {"law": "newtonian", "viscosity": viscosity}}, free


def _check_kinds(tests: tuple[MaterialTest, ...], fluid: bool) -> None:
    """Check that the tests of a folder go together: flow curves with a fluid, and stresses not with strains or curves."""
    for i, test in enumerate(tests):
        if (test.mode == "flow_curve") != fluid:
            want = "a declared fluid (model.flow)" if not fluid else "no other mode beside it"
            raise UserError(f"tests[{i}] ({test.name}).mode = {test.mode}: a flow curve takes {want}")
        if test.unit != tests[0].unit:
            raise UserError(
                f"tests[{i}] ({test.name}) and tests[0] ({tests[0].name}) measure different quantities (stress in Pa; strain or the "
                "logarithm of a curve): put them into two folders"
            )


def _check(tests: tuple[MaterialTest, ...], model: Mapping[str, Any]) -> None:
    """Check that the values are plausible; tests of one specimen together, because the rows of one test may be far from rest."""
    groups: dict[tuple, list[int]] = {}
    for i, test in enumerate(tests):
        if test.mode in CURVES:
            continue
        groups.setdefault((test.file, test.columns, test.mode, test.direction), []).append(i)
        if test.time is None and test.path.shape[1] == 1 and test.control == "strain":
            check_order(test.path[:, 0], f"tests[{i}] ({test.name}), {test.file.name}")
        check_rows(test.path, test.stress, test.time, f"tests[{i}] ({test.name}), {test.file.name}")
    for members in groups.values():
        first = tests[members[0]]
        where = f"tests[{members[0]}] ({first.name}), {first.file.name}"
        path, stress = (np.concatenate([getattr(tests[i], key) for i in members]) for key in ("path", "stress"))
        shear = first.mode == "simple_shear"
        if not shear:
            check_stretches(path, where)
        if first.control == "strain":
            check_stress(path, stress, model, where, timed=first.time is not None, rest=0.0 if shear else 1.0)


def _choose(columns: Mapping[str, Any], keys: tuple[str, ...], others: Mapping[str, str], where: str) -> tuple[str, ...]:
    """Choose the keys of columns, or their alternatives (logarithmic strain, true stress) if the file has these.

    Raises:
        UserError: The file has both kinds.
    """
    other = tuple(others.get(key, key) for key in keys)
    if other == keys:
        return keys
    chosen = other if any(key in columns for key in other) else keys
    if chosen == other and any(key in columns for key in keys):
        raise UserError(f"{where}.columns has both {', '.join(k for k in (*keys, *other) if k in columns)}: give one of the two")
    return chosen
