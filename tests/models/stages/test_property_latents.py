import pytest
import torch

from neuido.data.bodies.families import laws
from neuido.errors import UserError
from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
from neuido.models.operator.law_properties import p_wave_modulus, small_strain_moduli
from neuido.models.stages.property_latents import property_latents
from neuido.models.stages.true_properties import properties_of


@pytest.fixture(scope="module")
def operator():
    return IntrinsicDynamicsOperator.load("pretrained-materials").eval()


@pytest.mark.parametrize(
    ("family", "parameters"),
    [
        ("elastic", {"young": 1.5e5, "poisson": 0.28}),
        ("foam", {"young": 9e4, "poisson": 0.11, "exponent": 3.5}),
        ("sand", {"young": 3e5, "poisson": 0.22, "friction_angle": 31.0}),
        ("snow", {"young": 4e5, "poisson": 0.2, "compression": 0.02, "stretch": 0.006, "hardening": 2.0}),
    ],
)
def test_law_of_properties_has_them(operator, family, parameters):
    z = property_latents(operator)[family](properties_of(family, parameters))[None]
    true = float(laws(family, [parameters])[0].modulus())
    assert 1 / 1.15 < float(p_wave_modulus(operator, z)) / true < 1.15


def test_viscosity_and_stiffness_follow_what_is_asked(operator):
    of = property_latents(operator)
    viscosity = torch.stack([of["fluid"]({"viscosity": v}) for v in (0.5, 5.0, 50.0)])
    asked = torch.tensor([0.5, 5.0, 50.0])
    assert ((operator.viscosity(viscosity) / asked).log().abs() < 0.3).all()
    stiff = torch.stack([of["rubber"]({"young": e, "poisson": 0.44}) for e in (5e4, 1e5, 4e5)])
    assert (small_strain_moduli(operator, stiff)[0].diff() > 0).all()


def test_what_no_material_had_is_drawn_back(operator):
    of = property_latents(operator)["elastic"]
    far = of({"young": 1e12, "poisson": 0.3})
    assert torch.allclose(far, of({"young": 1e13, "poisson": 0.3}))
    assert float(p_wave_modulus(operator, far[None])) < 4e6


def test_operator_without_materials_is_refused():
    with pytest.raises(UserError, match="which materials"):
        property_latents(IntrinsicDynamicsOperator())
