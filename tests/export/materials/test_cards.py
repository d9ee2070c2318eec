"""Material cards hold the constants of a model, converted and with their units, and say what does not map."""

import math
from xml.etree import ElementTree

import pytest
import torch

from neuido.errors import UserError
from neuido.export.materials.cards import card_text, write_card
from neuido.export.materials.model_constants import UNITS, constants_of
from neuido.physics.laws.classical import material as elastic_law

E, NU, RHO = 1e6, 0.45, 1100.0
MU, K = E / (2 * (1 + NU)), E / (3 * (1 - 2 * NU))
RUBBER = {"density": RHO, "elasticity": {"law": "neo_hookean", "young": E, "poisson": NU}}
STEEL = {
    "density": 7800.0,
    "elasticity": {"law": "sigma", "young": 2e11, "poisson": 0.3},
    "plasticity": {"law": "von_mises", "yield_stress": 2e8},
}
SAND = {
    "density": 1600.0,
    "elasticity": {"law": "fixed_corotated", "young": 1e6, "poisson": 0.3},
    "plasticity": {"law": "drucker_prager", "friction_angle": 30.0},
}


def card(model: dict, to: str, units: str = "si", **effects: float) -> str:
    effects = {name.replace("__", "."): value for name, value in effects.items()}
    return card_text(constants_of(model | ({"effects": effects} if effects else {}), "a.yaml"), to, UNITS[units])


def numbers(text: str, keyword: str, lines: int = 1) -> list[float]:
    """Return the numbers on the lines that follow a keyword."""
    rows = text.splitlines()
    at = next(i for i, row in enumerate(rows) if row.startswith(keyword))
    return [
        float(word) for row in rows[at + 1 : at + 1 + lines] for word in row.partition("TBDATA,1,")[2 if "TBDATA" in row else 0].split(",")
    ]


def xml(text: str):
    return ElementTree.fromstring(text[text.index("-->") + 3 :].strip())


def test_neo_hookean_constants_and_units():
    assert numbers(card(RUBBER, "abaqus"), "*HYPERELASTIC, NEO HOOKE") == pytest.approx([MU / 2, 2 / K])
    text = card(RUBBER, "abaqus", "mm")
    assert numbers(text, "*HYPERELASTIC") == pytest.approx([MU / 2 * 1e-6, 2 / K * 1e6])
    assert numbers(text, "*DENSITY") == pytest.approx([RHO * 1e-12]) and "** units: mm, tonne, s, N, MPa" in text
    assert numbers(card(RUBBER, "ansys"), "TB,HYPER,MAT_ID,,,NEO") == pytest.approx([MU, 2 / K])
    material = xml(card(RUBBER, "febio"))
    assert material.get("type") == "neo-Hookean" and float(material.findtext("E")) == E and float(material.findtext("v")) == NU
    elasticity = xml(card(RUBBER, "mujoco", viscosity_shear__eta=50.0)).find(".//elasticity")
    assert float(elasticity.get("young")) == E and float(elasticity.get("damping")) == pytest.approx(50.0 / MU)


def test_hencky_and_corotated_laws_map_as_far_as_they_do():
    hencky = RUBBER | {"elasticity": {"law": "sigma", "young": E, "poisson": NU}}
    assert xml(card(hencky, "febio")).get("type") == "natural neo-Hookean"
    corotated = RUBBER | {"elasticity": {"law": "fixed_corotated", "young": E, "poisson": NU}}
    text = card(corotated, "abaqus")
    assert numbers(text, "*ELASTIC") == pytest.approx([E, NU]) and "equal at small strains alone" in text


def test_stiffening_and_second_invariant():
    """The expansions have the energies of the effects: compared at a small I1bar - 3 and I2bar - 3."""
    k, c, x = 0.05, 0.3, 1e-2
    C10, C20, C30, D, *_ = numbers(card(RUBBER, "abaqus", strain_stiffening__k=k), "*HYPERELASTIC, YEOH")
    assert C10 * x + C20 * x**2 + C30 * x**3 == pytest.approx(-MU / (2 * k) * math.log(1 - k * x), rel=1e-9)
    assert D == pytest.approx(2 / K)
    assert numbers(card(RUBBER, "ansys", strain_stiffening__k=k), "TB,HYPER,MAT_ID,,,GENT") == pytest.approx([MU, 1 / k, 2 / K])
    C10, C01, D = numbers(card(RUBBER, "abaqus", second_invariant__c=c), "*HYPERELASTIC, MOONEY-RIVLIN")
    assert C01 * x == pytest.approx(1.5 * MU * c * math.log(1 + x / 3), rel=2e-3)
    both = numbers(card(RUBBER, "abaqus", second_invariant__c=c, strain_stiffening__k=k), "*HYPERELASTIC, POLYNOMIAL, N=3", 2)
    assert both == pytest.approx([MU / 2, MU * c / 2, MU * k / 4, 0, 0, MU * k**2 / 6, 0, 0, 0, 2 / K, 0, 0])
    material = xml(card(RUBBER, "febio", second_invariant__c=c))
    assert material.get("type") == "Mooney-Rivlin" and float(material.findtext("c2")) == pytest.approx(MU * c / 2)
    assert xml(card(RUBBER, "febio", strain_stiffening__k=k)).get("type") == "Gent"
    assert "stable at moderate strains alone" in card(RUBBER, "abaqus", strain_stiffening__k=-0.05)


def test_relaxation_is_relative_to_what_each_program_takes():
    """The relaxation modulus that each card stands for is mu (1 + g exp(-t/T)) at the start and at the end."""
    g, T = 0.5, 0.1
    share, bulk, time = numbers(card(RUBBER, "abaqus", maxwell__ratio=g, maxwell__time=T), "*VISCOELASTIC, TIME=PRONY")
    assert (1 / (1 - share), bulk, time) == (pytest.approx(1 + g), 0.0, T)  # the elastic constants are long-term ones
    text = card(RUBBER, "ansys", maxwell__ratio=g, maxwell__time=T)
    instantaneous, share = numbers(text, "TB,HYPER")[0], numbers(text, "TB,PRONY")[0]
    assert instantaneous == pytest.approx(MU * (1 + g)) and instantaneous * (1 - share) == pytest.approx(MU)
    stiff = RUBBER | {"elasticity": {"law": "sigma", "young": E, "poisson": NU}}
    text = card(stiff, "ansys", maxwell__ratio=g, maxwell__time=T)
    young, poisson = (float(line.rpartition(",")[2]) for line in text.splitlines() if line.startswith(("MP,EX", "MP,PRXY")))
    assert young / (2 * (1 + poisson)) == pytest.approx(MU * (1 + g)) and young / (3 * (1 - 2 * poisson)) == pytest.approx(K)
    material = xml(card(RUBBER, "febio", maxwell__ratio=g, maxwell__time=T))
    assert (float(material.findtext("g1")), float(material.findtext("t1"))) == (g, T)
    assert float(material.find("elastic").findtext("c1")) == pytest.approx(MU / 2)
    assert "DOES NOT MAP and is left out: the relaxation" in card(RUBBER, "mujoco", maxwell__ratio=g, maxwell__time=T)
    loss = card(RUBBER, "abaqus", hysteresis__eta=0.1)
    assert sum(numbers(loss, "*VISCOELASTIC", 6)[::3]) < 1 and "DOES NOT MAP" not in loss


def test_plasticity_in_uniaxial_quantities():
    """At a plastic norm a the uniaxial stress is sqrt(3/2) (tau_Y + H a), over e = sqrt(2/3) a."""
    H, Hk, eta = 1e9, 2e9, 1e5
    table = numbers(card(STEEL, "abaqus", hardening__h=H), "*PLASTIC, HARDENING=ISOTROPIC", 2)
    e = table[3]
    assert table[:2] == pytest.approx([math.sqrt(1.5) * 2e8, 0]) and table[2] == pytest.approx(
        math.sqrt(1.5) * (2e8 + H * math.sqrt(1.5) * e)
    )
    text = card(STEEL, "abaqus", kinematic_hardening__h=Hk, rate_yield__eta=eta)
    assert numbers(text, "*PLASTIC, HARDENING=COMBINED") == pytest.approx([math.sqrt(1.5) * 2e8, 1.5 * Hk, 0])
    D, n = numbers(text, "*RATE DEPENDENT")
    norm_rate = 0.7  # <|s| - tau_Y>/eta
    sigma = math.sqrt(1.5) * (2e8 + eta * norm_rate)
    assert D * (sigma / (math.sqrt(1.5) * 2e8) - 1) ** n == pytest.approx(math.sqrt(2 / 3) * norm_rate)
    soft = numbers(card(STEEL, "abaqus", softening__s=3.0), "*PLASTIC", 21)
    assert soft[-2] == pytest.approx(math.sqrt(1.5) * 2e8 * math.exp(-3 * math.sqrt(1.5))) and soft[-1] == 1.0
    assert "TBPT,DEFI,1, " in card(STEEL, "ansys", hardening__h=H)
    elastic = RUBBER | {"elasticity": {"law": "sigma", "young": E, "poisson": NU}}
    assert numbers(card(elastic, "abaqus", yield__inverse=1e-4), "*PLASTIC")[0] == pytest.approx(math.sqrt(1.5) * 1e4)


def test_cone_of_sand():
    beta, ratio, dilation = numbers(card(SAND, "abaqus", cohesion__c=500.0), "*DRUCKER PRAGER, SHEAR")
    assert (ratio, dilation) == (1, 0) and math.tan(math.radians(beta)) == pytest.approx(6 * 0.5 / 2.5)
    cohesion = numbers(card(SAND, "abaqus", cohesion__c=500.0), "*DRUCKER PRAGER HARDENING")[0]
    assert cohesion == pytest.approx(1.2 * 500.0 / math.tan(math.radians(30)))
    assert numbers(card(SAND, "ansys", cohesion__c=500.0), "TB,EDP") == pytest.approx([1.2, cohesion])


def test_what_does_not_map_is_said(tmp_path):
    text = card(RUBBER, "abaqus", gravity__g=0.1, swelling__rate=0.1, tension_compression__r=0.2)
    assert "** not part of a material, model it in the scene: gravity" in text
    assert "** DOES NOT MAP and is left out: swelling, tension_compression" in text
    for to in ("febio", "mujoco"):
        for model in (STEEL, SAND):
            with pytest.raises(UserError, match=r"does not map to .* export to abaqus or ansys"):
                card(model, to)
    (tmp_path / "model_after.yaml").write_text(
        "density: 1\nelasticity: {law: sigma, young: 1e5, poisson: 0.3}\nlaw: {file: a.safetensors}\n"
    )
    with pytest.raises(UserError, match="a learned one, which no card can hold: give --to c"):
        write_card(tmp_path, "abaqus", tmp_path / "a.inp")
    for options, words in (({"units": "inch"}, "choose si"), ({"name": "a b"}, "starts with a letter")):
        with pytest.raises(UserError, match=words):
            write_card(tmp_path, "abaqus", tmp_path / "a.inp", **options)
    with pytest.raises(UserError, match="did you mean 'abaqus'"):
        write_card(tmp_path, "abacus", tmp_path / "a.inp")
    assert [path.name for path in tmp_path.iterdir()] == ["model_after.yaml"]


def test_incompressible_fit_has_no_bulk_term():
    assert numbers(card(RUBBER | {"incompressible": True}, "abaqus"), "*HYPERELASTIC")[1] == 0.0
    assert float(xml(card(RUBBER | {"incompressible": True}, "febio")).findtext("k")) == pytest.approx(1e3 * MU)


@pytest.mark.parametrize("law", ["neo_hookean", "sigma"])
def test_febio_has_these_laws_exactly(law):
    """The Cauchy stress by the formulas of FEBio's FENeoHookean and FENaturalNeoHookean with the constants of the card."""
    model = RUBBER | {"elasticity": {"law": law, "young": E, "poisson": 0.3}}
    material = xml(card(model, "febio"))
    young, poisson = float(material.findtext("E")), float(material.findtext("v"))
    mu, lame = young / (2 * (1 + poisson)), young * poisson / ((1 + poisson) * (1 - 2 * poisson))
    F = torch.eye(3, dtype=torch.float64) + 0.3 * torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    J, b = torch.linalg.det(F), F @ F.mT
    if material.get("type") == "neo-Hookean":
        stress = (mu * (b - torch.eye(3)) + lame * J.log() * torch.eye(3)) / J
    else:
        values, vectors = torch.linalg.eigh(b)
        hencky = vectors @ torch.diag(values.log() / 2) @ vectors.mT
        volume = hencky.trace() / 3 * torch.eye(3)
        stress = (young / (1 - 2 * poisson) * volume + 2 * mu * (hencky - volume)) / J
    own = elastic_law(model["elasticity"], None)[0](F[None])[0] / J
    assert J > 0.3 and torch.allclose(own, stress, rtol=1e-7, atol=1e-7 * E)  # the law has its constants in float32
