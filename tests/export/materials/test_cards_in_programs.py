"""Cards run in the programs that they are for: CalculiX, which reads Abaqus' syntax, and MuJoCo. Each is skipped without its program."""

import re
import subprocess
from shutil import which

import numpy as np
import pytest
import torch

from neuido.export.materials.cards import card_text
from neuido.export.materials.model_constants import UNITS, constants_of
from neuido.physics.effects.parameters import Effects
from neuido.physics.laws.classical import NeoHookean, Sigma, VonMises
from neuido.physics.points.material_point import Specimen, stress_along

E, NU, STEEL_E, YIELD = 1e6, 0.499, 2e11, 2e8
RUBBER = {"density": 1100.0, "elasticity": {"law": "neo_hookean", "young": E, "poisson": NU}}
STEEL = {
    "density": 7800.0,
    "elasticity": {"law": "sigma", "young": STEEL_E, "poisson": 0.3},
    "plasticity": {"law": "von_mises", "yield_stress": YIELD},
}
SOFT = {"density": 1000.0, "elasticity": {"law": "fixed_corotated", "young": 1e5, "poisson": 0.3}}
DECK = """*NODE, NSET=ALL
1, 0, 0, 0
2, 1, 0, 0
3, 1, 1, 0
4, 0, 1, 0
5, 0, 0, 1
6, 1, 0, 1
7, 1, 1, 1
8, 0, 1, 1
*ELEMENT, TYPE=C3D8, ELSET=BLOCK
1, 1, 2, 3, 4, 5, 6, 7, 8
*NSET, NSET=TOP
5, 6, 7, 8
{card}*SOLID SECTION, ELSET=BLOCK, MATERIAL=neuido
*BOUNDARY
1, 1, 3
2, 2, 3
3, 3
4, 1
4, 3
5, 1, 2
6, 2
8, 1
*STEP, NLGEOM, INC=1000
*STATIC
0.05, 1, 1e-6, 0.05
*BOUNDARY
TOP, 3, 3, {stretch}
*NODE PRINT, NSET=TOP, TOTALS=ONLY
RF
*END STEP
"""


def card(model: dict, to: str, units: str = "si", **effects: float) -> str:
    return card_text(constants_of(model | ({"effects": effects} if effects else {}), "a.yaml"), to, UNITS[units])


def pulled(folder, text: str, strain: float) -> tuple[float, str]:
    """Return the nominal stress of a unit cube that CalculiX stretches, and what it warned of."""
    (folder / "cube.inp").write_text(DECK.format(card=text, stretch=strain))
    done = subprocess.run(["ccx", "cube"], cwd=folder, capture_output=True, text=True, check=True, timeout=60)
    last = re.findall(r"total force[^\n]*\n\s*\n\s*(.+)", (folder / "cube.dat").read_text())[-1]
    return float(last.split()[2]), " ".join(re.findall(r"\*(?:WARNING|ERROR)[^\n]*\n[^\n]*", done.stdout))


def measured(specimen: Specimen, strain: float) -> float:
    """Return the same of neuido."""
    path = torch.linspace(1.0, 1.0 + strain, 41, dtype=torch.float64)[1:, None]
    return float(stress_along(specimen, "uniaxial", path, step=1e-3)[0, -1, 0])


def rubber(**effects: float) -> Specimen:
    return Specimen(NeoHookean(E, NU), None, Effects(**{name: torch.tensor([value]) for name, value in effects.items()}), 1)


def steel(**effects: float) -> Specimen:
    plastic = VonMises(YIELD, STEEL_E, 0.3)
    return Specimen(Sigma(STEEL_E, 0.3), plastic, Effects(**{name: torch.tensor([value]) for name, value in effects.items()}), 1)


@pytest.mark.skipif(which("ccx") is None, reason="needs CalculiX: apt install calculix-ccx")
@pytest.mark.parametrize(
    ("model", "specimen", "effects", "strain", "bound"),
    [
        (RUBBER, rubber, {}, 1.0, 3e-3),
        (RUBBER, rubber, {}, -0.3, 3e-3),
        (RUBBER, rubber, {"strain_stiffening": 0.05}, 0.5, 5e-3),
        (RUBBER, rubber, {"second_invariant": 0.3}, 0.1, 5e-3),
        (STEEL, steel, {}, 0.1, 2e-3),
        (STEEL, steel, {"hardening": 1e9}, 0.1, 5e-3),
        (STEEL, steel, {"softening": 3.0}, 0.1, 5e-3),
    ],
    ids=lambda value: next(iter(value), "plain") if isinstance(value, dict) and "density" not in value else None,
)
def test_calculix_stretches_a_cube_as_neuido_does(tmp_path, model, specimen, effects, strain, bound):
    keys = {"strain_stiffening": "strain_stiffening.k", "second_invariant": "second_invariant.c", "hardening": "hardening.h"}
    named = {keys.get(name, "softening.s"): value for name, value in effects.items()}
    stress, warnings = pulled(tmp_path, card(model, "abaqus", **named), strain)
    assert stress == pytest.approx(measured(specimen(**effects), strain), rel=bound)
    assert "not recognized" not in warnings and "interpreted" not in warnings
    millimetres, _ = pulled(tmp_path, card(model, "abaqus", "mm", **named), strain)
    assert millimetres == pytest.approx(1e-6 * stress, rel=2e-3)  # its own bulk terms of higher order, of Yeoh, depend on the unit


def loaded(text: str):
    """Return a compiled model of a card, without gravity and contact."""
    mujoco = pytest.importorskip("mujoco")
    spec = mujoco.MjSpec.from_string(text[text.index("<mujoco") :])
    spec.option.gravity = [0, 0, 0]
    for flex in spec.flexes:
        flex.contype = flex.conaffinity = 0
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return mujoco, model, data


@pytest.mark.filterwarnings("ignore:flex .* is not rigid")  # MuJoCo 4.0 overlooks elasticity there
@pytest.mark.parametrize("units", ["si", "mm"])
def test_mujoco_stretches_its_block_by_saint_venant_and_kirchhoffs_law(units):
    """Equal and opposite tractions on two faces: a linear mesh gives the exact homogeneous strain."""
    mujoco, model, data = loaded(card(SOFT, "mujoco", units))
    rest, young, traction = data.flexvert_xpos.copy(), 1e5 * UNITS[units].stress, 1e3 * UNITS[units].stress
    height, force = rest[:, 2], np.zeros_like(rest)
    for triangle in model.flex_shell.reshape(-1, 3):
        a, b, c = rest[triangle]
        if np.ptp(height[triangle]) < 1e-9:
            force[triangle, 2] += np.sign(a[2] - height.mean()) * traction * np.linalg.norm(np.cross(b - a, c - a)) / 6
    for _ in range(2000):
        data.xfrc_applied[model.flex_vertbodyid, :3] = force
        mujoco.mj_step(model, data)
        data.qvel *= 0.97
    ones = np.ones((len(rest), 1))
    affine = np.linalg.lstsq(np.hstack([rest, ones]), data.flexvert_xpos, rcond=None)[0]
    stretch, across = affine[2, 2], affine[0, 0]
    assert np.abs(np.hstack([rest, ones]) @ affine - data.flexvert_xpos).max() < 1e-6 * np.ptp(rest)
    assert traction == pytest.approx(young * stretch * (stretch**2 - 1) / 2, rel=1e-4)
    assert (1 - across**2) / (stretch**2 - 1) == pytest.approx(0.3, rel=1e-3)
    assert traction == pytest.approx(young * (stretch - 1), rel=0.02)  # small strains: every law


@pytest.mark.filterwarnings("ignore:flex .* is not rigid")
@pytest.mark.parametrize("young", [1e4, 1e9])
def test_mujoco_is_stable_at_the_time_step_of_the_card(young):
    mujoco, model, data = loaded(card(SOFT | {"elasticity": {"law": "sigma", "young": young, "poisson": 0.45}}, "mujoco"))
    data.qvel[:] = np.random.default_rng(0).normal(size=model.nv)
    data.qvel *= 0.05 * np.sqrt(young / 1000.0) / np.abs(data.qvel).max()
    before = 0.5 * (data.qvel**2).sum()
    for _ in range(500):
        mujoco.mj_step(model, data)
    assert 0.5 * (data.qvel**2).sum() < 1.05 * before
