"""The weights that come with the package: small, loadable, near the laws they were trained on, and described by their card."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch

from neuido.data.bodies.families import PARAMETERS, PUBLISHED, laws
from neuido.models.operator.dynamics_operator import PRETRAINED, IntrinsicDynamicsOperator
from neuido.models.stages.operator_scores import silhouette
from neuido.models.stages.pretrain import PretrainModule

FAMILIES_OF_CARD = {"pretrained-materials": tuple(PARAMETERS)}
"""Families that the card of an operator lists, where they are not the first three."""
FAMILY_OF = {name: family for family, (name, _) in PUBLISHED.items()}


@pytest.fixture(scope="module", params=[name for name in PRETRAINED if name != "pretrained-bounded"])  # another name of `pretrained`
def name_of_file(request) -> str:
    return request.param


@pytest.fixture(scope="module")
def operator(name_of_file) -> IntrinsicDynamicsOperator:
    return IntrinsicDynamicsOperator.load(name_of_file)


def deformations(strain: float, count: int = 2000) -> torch.Tensor:
    return torch.eye(3) + strain * torch.randn(count, 3, 3, generator=torch.Generator().manual_seed(0))


def test_file(operator, name_of_file):
    assert PRETRAINED[name_of_file].stat().st_size < 4e6
    assert set(FAMILY_OF) <= set(operator.latent_names)
    assert len(operator.latents) == (480 if name_of_file == "pretrained-materials" else 90)
    trunk = {"pretrained": "bounded", "pretrained-materials": "general"}.get(name_of_file, "objective")
    assert operator.config["trunk"] == trunk
    assert operator.config.get("viscous", False) == (trunk == "general")
    assert operator.config["latent_dim"] == 128


@pytest.mark.parametrize("name", FAMILY_OF)
@torch.no_grad()
def test_laws_are_near_the_classical_ones(operator, name):
    family = FAMILY_OF[name]
    classical, flow = laws(family, [PUBLISHED[family][1]])
    elastic, plastic = operator.laws(operator.latent(name))
    assert elastic.modulus().item() == pytest.approx(classical.modulus().item(), rel=0.01)
    assert elastic(torch.eye(3)[None]).abs().max() == 0
    F = deformations(1e-2)
    stress = classical(F)
    error = (elastic(F) - stress).flatten(1).norm(dim=1) / stress.flatten(1).norm(dim=1)
    assert error.median() <= 0.02
    corrected = flow(F)
    residual = (corrected - F).flatten(1).norm(dim=1)
    wrong = (plastic(F) - corrected).flatten(1).norm(dim=1)
    flows = residual > 1e-5
    if name == "jelly":
        assert not flows.any() and wrong.max() < 1e-6
    else:
        assert flows.any() and (wrong / residual)[flows].median() < 0.02


@torch.no_grad()
def test_eight_families_and_their_viscosities():
    """Only fluids have a viscosity, and what they are sheared by is forgotten."""
    operator = IntrinsicDynamicsOperator.load("pretrained-materials")
    families = np.array(operator.latent_families)
    assert {family: int((families == family).sum()) for family in PARAMETERS} == dict.fromkeys(PARAMETERS, 60)
    assert float(silhouette(operator.latents, operator.latent_families)) == pytest.approx(0.616, abs=0.005)
    viscosity = operator.viscosity(operator.latents)
    assert viscosity[~np.isin(families, ("fluid", "viscoplastic"))].max() < 1e-3  # Pa s
    assert 0.09 < viscosity[families == "fluid"].min() < 0.2 < 50 < viscosity[families == "fluid"].max() < 101
    F = deformations(1e-2, 300)
    fluids = operator.latents[torch.from_numpy(families == "fluid")]
    kept = deviator(operator.plastic(fluids, F.expand(60, *F.shape))) / deviator(F)
    assert kept.median() < 2e-3 and kept.max() < 0.02


def deviator(F: torch.Tensor) -> torch.Tensor:
    """The norm of the deviator of the Hencky strain."""
    strain = torch.linalg.svdvals(F).log()
    return (strain - strain.mean(-1, keepdim=True)).norm(dim=-1)


@torch.no_grad()
def test_materials_differ(operator):
    """The check above would pass for one law under three names if the names were mixed up; they are not."""
    F = deformations(1e-2)
    stiffness = {name: operator.laws(operator.latent(name))[0](F).norm().item() for name in FAMILY_OF}
    assert stiffness["jelly"] * 2 < stiffness["plasticine"] < stiffness["sand"] / 2


@pytest.mark.parametrize("name", PRETRAINED)
@torch.no_grad()
def test_the_page_of_the_weights_says_which_have_the_right_sign_everywhere(name):
    """Compressed matter resists and inverted matter is turned back, for each latent of the file; `test_bounded` has the whole grid."""
    operator = IntrinsicDynamicsOperator.load(name)
    size = torch.tensor([0.01, 0.1, 0.2, 0.5])[:, None]
    squeezed, inverted = torch.diag_embed(size.expand(4, 3)), torch.diag_embed(size * torch.tensor([-1.0, 1.0, 1.0]))
    pressure = -operator.elastic(operator.latents, squeezed.expand(len(operator.latents), 4, 3, 3)).diagonal(dim1=-2, dim2=-1).sum(-1)
    back = operator.elastic(operator.latents, inverted.expand(len(operator.latents), 4, 3, 3))[..., 0, 0]
    right = bool((pressure > 0).all() and (back > 0).all())
    page = (Path(__file__).parents[3] / "docs/reference/weights.md").read_text()
    (row,) = [line for line in page.splitlines() if line.startswith("| ") and f"`{name}`" in line]
    assert ("right sign of the stress at every deformation" in row) == right


def test_a_fit_starts_from_them(operator, name_of_file):
    viscous = operator.config.get("viscous", False)
    module = PretrainModule(len(operator.latents), operator.trunk, viscous=viscous, init_from=name_of_file)
    for (name, mine), theirs in zip(module.operator.state_dict().items(), operator.state_dict().values(), strict=True):
        assert torch.equal(mine, theirs), name
    assert torch.equal(module.latents, operator.latents)
    other = PretrainModule(
        6, operator.trunk, viscous=viscous, init_from=name_of_file
    )  # other trajectories: the weights without their latents
    assert torch.equal(other.operator.elastic_trunk.out.weight, operator.elastic_trunk.out.weight)
    assert other.latents.shape == (6, 128)


def test_the_card_quotes_the_file(operator, name_of_file):
    """Every figure of the card's first table is that of the file, and so are date and number of steps."""
    file = PRETRAINED[name_of_file]
    named = FAMILIES_OF_CARD.get(name_of_file, ("elastic", "plasticine", "sand"))
    card = (file.parent / "README.md").read_text().split(f"# Model card: `{file.name}`")[1].split("# Model card: ")[0]
    section = card.split("## Figures")[1].split("Median relative error of the stress, over")[0]
    rows = dict(re.findall(r"^\| ([^|]+?) \| (.+) \|$", section, flags=re.MULTILINE))
    figures = operator.card["figures"]
    keys = {
        "stress error": ["stress_error"],
        "stress error, " + " / ".join(named): [f"stress_error/{family}" for family in named],
        "stress MSE [Pa²]": ["stress_mse"],
        "plastic error where it flows": ["plastic_error_yielding"],
        "plastic error, elastic / plasticine / sand": [f"plastic_error/{family}" for family in ("elastic", "plasticine", "sand")],
        "plastic MSE": ["plastic_mse"],
    }
    for title, names in keys.items():
        for stage, cell in zip(("val", "instance"), rows[title].split(" | "), strict=True):
            quoted = [float(number) for number in cell.split(" / ")]
            assert quoted == pytest.approx([figures[f"{stage}/{name}"] for name in names], rel=5e-3), (title, stage)
    assert operator.card["date"] in card
    assert f"{operator.card['steps']:,} steps" in card
