"""The stress of an isotropic law along a path: `PointLaw` by a kernel, for stretches along the axes and for simple shear.

A path of hundreds of rows takes milliseconds a parameter set. The tests compare it with `PointLaw`.
"""

from typing import TYPE_CHECKING

import numpy as np
import torch

from neuido.physics.effects.coefficients import DRUCKER_PRAGER
from neuido.physics.laws.classical import FixedCorotated, NeoHookean, Sigma, VonMises
from neuido.physics.points.plastic_step import BACKSTRESSES
from neuido.physics.points.specimen import Specimen

if TYPE_CHECKING:
    from neuido.physics.points.rig import Rig

LAWS = {NeoHookean: "neo_hookean", Sigma: "sigma", FixedCorotated: "fixed_corotated"}
"""Elastic laws that are computed here, by their names in the kernel."""
MATERIAL = ("k", "c", "r", "", "", "", "", "damage", "lock")
"""Columns of the kernel's table for those of `coefficients.Tables.material`; the fibre is not computed here."""
FLOW = ("two_mu", "inverse", "H", "s", "H_k", "eta")
"""The same for `coefficients.Tables.flow`."""
POINT = {
    ("compaction", "k"): "compaction", ("compaction", "lock"): "compaction_lock", ("mullins", "share"): "mullins",
    ("mullins", "width"): "mullins_width", ("permanent_set", "share"): "set", ("cyclic_hardening", "q"): "q",
    ("cyclic_hardening", "b"): "b", ("rate_power", "k"): "rate_k", ("rate_power", "n"): "rate_n", ("creep", "rate"): "creep",
    ("creep", "exponent"): "creep_n", ("creep", "stress"): "creep_stress",
} | {("nonlinear_backstress", f"{key}{i + 1}"): f"{key}{i + 1}" for i in range(BACKSTRESSES) for key in "hg"}  # fmt: skip
"""The same for parameters of `point_library`."""


class PlaneEngine:
    """The stress of P parameter sets of one specimen, with their state; see `rig.Engine`."""

    def __init__(self, rig: "Rig") -> None:
        import warp as wp

        from neuido.physics.points.plane_kernels import COLUMNS, build

        specimen, P = rig.specimen, rig.specimen.points
        law = specimen.law()
        columns = {name: np.zeros(P) for name in COLUMNS}

        def put(name: str, rows: torch.Tensor) -> None:
            columns[name] = rows.detach().double().expand(P).numpy()

        for given in specimen.effects.point or {}:
            effect, _, part = given.partition(".")
            if (effect, part) in POINT:
                put(POINT[effect, part], law.value(effect, part))
        for name, rows in zip(("mu", "lam"), specimen.elasticity.tensors()[0].double().unbind(-1), strict=True):
            put(name, rows)
        flow = law.tables.flow if law.tables.flow is not None or law.plasticity is None else law.yields()
        for names, table in ((MATERIAL, law.tables.material), (FLOW, flow)):
            for name, rows in zip(names, () if table is None else table.unbind(1), strict=False):
                if name:
                    put(name, rows)
        if flow is None:
            put("two_mu", 2 * law.shear())
        effects, like = specimen.effects, torch.zeros((), dtype=torch.float64)
        if (viscosity := effects.viscosity(P, like)) is not None:
            put("shear", viscosity[:, 0])
            put("bulk", viscosity[:, 1])
        for name, effect in (("growth", "stiffness_change"), ("swelling", "swelling")):
            if getattr(effects, effect) is not None:
                put(name, effects.rows(effect, P, like)[:, 0])
        columns["modulus"] = rig.scale
        tables = law.tables.branches
        branches = np.zeros((P, 0, 2)) if tables is None else tables.detach().double().expand(P, *tables.shape[1:]).numpy()
        self.rig, self.kind = rig, list(LAWS.values()).index(LAWS[type(specimen.elasticity)])
        state, matrix, self.kernel = build()
        self.table = wp.array(np.stack([columns[name] for name in COLUMNS], 1), dtype=wp.float64, device="cpu")
        self.branches = wp.array(np.ascontiguousarray(branches), dtype=wp.vec2d, device="cpu")

        def zeros(*shape: int, of: type = wp.vec4d) -> wp.array:
            return wp.zeros(shape, dtype=of, device="cpu")

        own = self.state = state()
        own.total, own.beta, own.kept, own.q, own.backs = zeros(P), zeros(P), zeros(P), zeros(P, branches.shape[1]), zeros(P, BACKSTRESSES)
        own.alpha, own.e_max, own.x_max = (zeros(P, of=wp.float64) for _ in range(3))
        own.F = wp.array(np.tile([1.0, 0.0, 0.0, 1.0, 1.0], (P, 1)), dtype=matrix, device="cpu")
        self.unknowns, self.ratios = zeros(P, of=wp.vec2d), zeros(P, of=wp.vec2d)
        self.last = np.zeros(2)

    @staticmethod
    def serves(specimen: Specimen) -> bool:
        """Return whether a specimen is one of those that this engine knows."""
        flows = specimen.plasticity is None or specimen.plasticity.identity or isinstance(specimen.plasticity, VonMises)
        e = specimen.effects
        cone = DRUCKER_PRAGER in specimen.law().tables.kinds
        return flows and not cone and type(specimen.elasticity) in LAWS and e.fibre is None and e.stiffness is None

    def follow(self, gaps: np.ndarray, timed: bool, now: float, step: float) -> tuple[np.ndarray, np.ndarray]:
        """Go through all rows of the path; see `rig.Engine`."""
        import warp as wp

        from neuido.physics.points.plane_kernels import MODES

        rig, P, n = self.rig, self.rig.specimen.points, len(self.rig.path)
        path = np.zeros((n, 2))
        path[:, : rig.path.shape[1]] = rig.path

        def array(values: np.ndarray, dtype: type) -> wp.array:
            return wp.array(np.ascontiguousarray(values), dtype=dtype, device="cpu")

        pieces = rig.pieces(np.concatenate([self.last[None, : rig.path.shape[1]], rig.path]), step)
        es, ts = (wp.empty((P, n), dtype=wp.vec4d, device="cpu") for _ in "et")
        given = [array(path, wp.vec2d), array(gaps, wp.float64), array(pieces, wp.int32), now, int(timed), wp.vec2d(*self.last)]
        given += [self.kind, MODES.index(rig.mode), rig.lead, int(rig.specimen.incompressible), int(rig.true_stress), rig.unknowns]
        given += [self.table, self.branches, self.state, self.unknowns, self.ratios]
        wp.launch(self.kernel, dim=P, inputs=given, outputs=[es, ts], device="cpu")
        self.last = path[-1]
        return es.numpy().copy(), ts.numpy().copy()
