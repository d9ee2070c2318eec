import math

import pytest
import torch

from neuido.errors import UserError
from neuido.physics.effects.parameters import Effects
from neuido.physics.laws.classical import FixedCorotated, NeoHookean, Sigma, VonMises
from neuido.physics.points.material_point import Specimen, stress_along, turn

YOUNG = 1.2e6
MU = YOUNG / (2 * 1.499)


def rubber(points: int = 1, **effects) -> Specimen:
    return Specimen(NeoHookean(YOUNG, 0.499), None, Effects(**effects), points, incompressible=True)


def steel(points: int = 1, *, yield_stress: float = 3e8, **effects) -> Specimen:
    return Specimen(Sigma(2e11, 0.3), VonMises(yield_stress, 2e11, 0.3), Effects(**effects), points)


def column(*values) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)[:, None]


L = column(0.6, 0.9, 1.0, 1.3, 2.0, 3.0)
l = L[:, 0]


def test_incompressible_neo_hookean():
    torch.testing.assert_close(stress_along(rubber(), "uniaxial", L)[0, :, 0], MU * (l - l**-2))
    torch.testing.assert_close(stress_along(rubber(), "uniaxial", L, true_stress=True)[0, :, 0], MU * (l**2 - 1 / l))
    torch.testing.assert_close(stress_along(rubber(), "equibiaxial", L)[0, :, 0], MU * (l - l**-5))
    torch.testing.assert_close(stress_along(rubber(), "pure_shear", L)[0, :, 0], MU * (l - l**-3))
    torch.testing.assert_close(stress_along(rubber(), "simple_shear", L)[0, :, 0], MU * l)
    other = 0.5 + l / 3
    both = stress_along(rubber(), "biaxial", torch.stack([l, other], 1))[0]
    third = 1 / (l * other) ** 2
    torch.testing.assert_close(both, MU * torch.stack([(l**2 - third) / l, (other**2 - third) / other], 1))


def test_small_strain_of_a_compressible_body():
    """Young's modulus, and that over 1 - nu^2 where the second axis is held."""
    small = column(1 - 1e-6, 1 + 1e-6)
    for law in (NeoHookean, FixedCorotated, Sigma):
        specimen = Specimen(law(1e5, 0.3), None, Effects(), 1)
        for mode, modulus in (("uniaxial", 1e5), ("pure_shear", 1e5 / (1 - 0.09)), ("equibiaxial", 1e5 / 0.7)):
            torch.testing.assert_close(
                stress_along(specimen, mode, small)[0] / (small - 1), torch.full_like(small, modulus), rtol=1e-4, atol=0
            )


def test_compressible_hencky():
    """Sigma elasticity in uniaxial tension: the Kirchhoff stress is E ln(stretch), the volume stretch^(1 - 2 nu)."""
    specimen = Specimen(Sigma(1e5, 0.3), None, Effects(), 1)
    torch.testing.assert_close(stress_along(specimen, "uniaxial", L)[0, :, 0], 1e5 * l.log() / l, rtol=1e-7, atol=1e-4)
    torch.testing.assert_close(
        stress_along(specimen, "uniaxial", L, true_stress=True)[0, :, 0], 1e5 * l.log() / l**0.4, rtol=1e-7, atol=1e-4
    )


def test_fibre_along_and_across():
    """Along the fibre W = c/4 (l^2 - 1)^2 adds c (l^2 - 1) l; across it the fibre shortens and holds its direction."""
    c, e = 3e5, 1e-6
    along = stress_along(rubber(fibre=c, fibre_direction=(1.0, 0.0, 0.0)), "uniaxial", L)[0, :, 0]
    torch.testing.assert_close(along, MU * (l - l**-2) + c * (l**2 - 1) * l, rtol=1e-8, atol=1e-3)
    turned = stress_along(rubber(fibre=c, fibre_direction=(0.0, 1.0, 0.0)), "uniaxial", L, direction=(0.0, 1.0, 0.0))[0, :, 0]
    torch.testing.assert_close(turned, along, rtol=1e-8, atol=1e-3)
    # lateral strains -1/2 + d along the fibre and -1/2 - d balance where (2 mu + 2 c)(d - 1/2) = -2 mu (d + 1/2)
    across = stress_along(rubber(fibre=c, fibre_direction=(0.0, 1.0, 0.0)), "uniaxial", column(1 + e))[0, 0, 0] / e
    d = 0.5 * c / (2 * MU + c)
    torch.testing.assert_close(across, torch.tensor(2 * MU * (1.5 + d), dtype=torch.float64), rtol=1e-4, atol=0)


def test_compressible_fibre_balances_both_lateral_stresses():
    specimen = Specimen(NeoHookean(1e5, 0.3), None, Effects(fibre=1e5, fibre_direction=(1.0, 1.0, 0.0)), 1)
    path = column(1.0, 1.2, 1.5)
    stress = stress_along(specimen, "uniaxial", path)[0, :, 0]
    energies = []  # the work done equals the stored energy: its slope along the path is the nominal stress
    for s in (-1e-3, 1e-3):
        energies.append(_energy(specimen, path[1:, 0] + s))
    torch.testing.assert_close((energies[1] - energies[0]) / 2e-3, stress[1:], rtol=1e-4, atol=1.0)


def _energy(specimen: Specimen, stretch: torch.Tensor) -> torch.Tensor:
    """The least energy of diag(stretch, a, b) over a and b, by its own Newton iteration with autograd."""
    mu, lam = specimen.elasticity.tensors()[0][0]
    out = []
    for value in stretch:

        def energy(u, value=value):
            s = torch.cat([value[None], u.exp()])
            J = s.prod()
            I4 = (s[0] ** 2 + s[1] ** 2) / 2
            return mu / 2 * (s @ s - 3) - mu * J.log() + lam / 2 * J.log() ** 2 + 1e5 / 4 * (I4 - 1) ** 2

        u = torch.zeros(2, dtype=torch.float64)
        for _ in range(30):
            g, H = torch.func.grad(energy)(u), torch.func.hessian(energy)(u)
            u = u - torch.linalg.solve(H, g)
        out.append(energy(u))
    return torch.stack(out)


def test_von_mises_plateau():
    """The norm of the deviator is sqrt(2/3) of the uniaxial stress: the plateau is sqrt(3/2) of the declared norm."""
    strain = torch.linspace(0, 0.02, 41, dtype=torch.float64)
    stress = stress_along(steel(), "uniaxial", strain.exp()[:, None])[0, :, 0] * strain.exp()  # Kirchhoff over the lateral area
    torch.testing.assert_close(stress[1:4], 2e11 * strain[1:4], rtol=1e-6, atol=0)
    torch.testing.assert_close(stress[10:], torch.full_like(stress[10:], math.sqrt(1.5) * 3e8), rtol=1e-6, atol=0)


def test_kinematic_hardening_loop():
    """The uniaxial slope is E h / (E + h) with h = 1.5 H_k, and flow starts anew after a reversal by twice the yield stress."""
    H, E, Y = 4e9, 2e11, math.sqrt(1.5) * 3e8
    strain = torch.cat([torch.linspace(0, 0.015, 61), torch.linspace(0.015, -0.015, 121)[1:]]).double()
    stress = stress_along(steel(kinematic_hardening=H), "uniaxial", strain.exp()[:, None])[0, :, 0] * strain.exp()
    slope, h = stress.diff() / strain.diff(), 1.5 * H
    expected = E * h / (E + h)
    torch.testing.assert_close(slope[20:60], torch.full_like(slope[20:60], expected), rtol=1e-5, atol=0)
    torch.testing.assert_close(slope[100:], torch.full_like(slope[100:], expected), rtol=1e-5, atol=0)
    torch.testing.assert_close(slope[61:70], torch.full_like(slope[61:70], E), rtol=1e-5, atol=0)
    peak, e_peak = stress[60], strain[60]
    at = strain[100]  # back on the other branch: 2 Y down along E, then along the hardening slope
    torch.testing.assert_close(stress[100], peak - 2 * Y - expected * ((e_peak - at) - 2 * Y / E), rtol=1e-5, atol=0)


def test_isotropic_hardening_grows_the_loop():
    strain = torch.cat(
        [torch.linspace(0, 0.015, 31), torch.linspace(0.015, -0.015, 61)[1:], torch.linspace(-0.015, 0.015, 61)[1:]]
    ).double()
    stress = stress_along(steel(hardening=2e9), "uniaxial", strain.exp()[:, None], true_stress=True)[0, :, 0]
    assert float(stress[30]) < -float(stress[90]) < float(stress[150])


def test_maxwell_relaxation_and_kelvin_voigt():
    time = torch.cat([torch.tensor([0.0, 1e-4]), torch.linspace(0.1, 3, 30)]).double()
    held = torch.full((32, 1), 1.02, dtype=torch.float64)
    held[0] = 1.0
    stress = stress_along(rubber(maxwell_ratio=0.8, maxwell_time=0.7), "uniaxial", held, time=time)[0, :, 0]
    elastic = stress_along(rubber(), "uniaxial", held)[0, 1, 0]
    extra = 2 * 0.8 * MU * 1.5 * math.log(1.02) / 1.02 * torch.exp(-time[1:] / 0.7)
    torch.testing.assert_close(stress[1:], elastic + extra, rtol=1e-4, atol=0)
    ramp = torch.exp(0.05 * time)[:, None]
    viscous = stress_along(rubber(viscosity_shear=1e4), "uniaxial", ramp, time=time, true_stress=True)[0, 1:, 0]
    torch.testing.assert_close(viscous, MU * (ramp[1:, 0] ** 2 - 1 / ramp[1:, 0]) + 3 * 1e4 * 0.05, rtol=1e-6, atol=0)


def test_rate_raises_the_yield_stress():
    """Perzyna: steady flow at the rate r of the norm of the plastic strain has the overstress eta r."""
    strain = torch.linspace(0, 0.03, 31, dtype=torch.float64)
    eta, rate = 1e9, 0.1
    stress = stress_along(steel(rate_yield=eta), "uniaxial", strain.exp()[:, None], time=strain / rate)[0, -1, 0] * strain[-1].exp()
    torch.testing.assert_close(stress, torch.tensor(math.sqrt(1.5) * (3e8 + eta * math.sqrt(1.5) * rate)).double(), rtol=1e-3, atol=0)


def test_history_is_carried_and_steps_do_not_matter():
    """A body that remembers, in rows of any spacing: a path twice as fine gives the same, and so does one without a history."""
    strain = torch.linspace(0, 0.02, 11, dtype=torch.float64)
    fine = torch.linspace(0, 0.02, 21, dtype=torch.float64)
    a = stress_along(steel(kinematic_hardening=4e9), "uniaxial", strain.exp()[:, None])
    b = stress_along(steel(kinematic_hardening=4e9), "uniaxial", fine.exp()[:, None])
    torch.testing.assert_close(a, b[:, ::2], rtol=1e-6, atol=1.0)
    elastic = Specimen(NeoHookean(1e5, 0.3), None, Effects(strain_stiffening=0.2), 1)
    marched = elastic._replace(plasticity=VonMises(1e9, 1e5, 0.3))  # never yields
    for mode in ("uniaxial", "equibiaxial", "pure_shear", "simple_shear"):
        torch.testing.assert_close(stress_along(elastic, mode, L), stress_along(marched, mode, L), rtol=1e-6, atol=1e-2)


def test_a_batch_equals_its_members():
    k = torch.tensor([0.0, 0.1, 0.3], dtype=torch.float64)
    young = torch.tensor([1e6, 1.1e6, 2e6], dtype=torch.float64)
    fibres = Effects(fibre=1e5, fibre_direction=(1.0, 0.3, 0.1))
    whole = stress_along(Specimen(NeoHookean(young, 0.4), None, fibres._replace(strain_stiffening=k), 3), "uniaxial", L)
    for i in range(3):
        one = Specimen(NeoHookean(float(young[i]), 0.4), None, fibres._replace(strain_stiffening=float(k[i])), 1)
        torch.testing.assert_close(stress_along(one, "uniaxial", L)[0], whole[i], rtol=1e-6, atol=1e-2)


def test_direction_of_the_machine():
    for d in ((1.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0), (-1.0, 0, 0), (0.6, 0.0, 0.8), (0.48, 0.6, 0.64)):
        R = turn(torch.tensor(d, dtype=torch.float64))
        torch.testing.assert_close(R[:, 0], torch.tensor(d, dtype=torch.float64))
        torch.testing.assert_close(R @ R.mT, torch.eye(3, dtype=torch.float64))
        assert torch.linalg.det(R) > 0


def test_what_has_no_equilibrium_is_nan_alone():
    """A very negative stiffening tears the body apart; the others of the batch are not touched."""
    specimen = Specimen(NeoHookean(1e5, 0.3), None, Effects(tension_compression=torch.tensor([0.0, 1e300], dtype=torch.float64)), 2)
    out = stress_along(specimen, "uniaxial", L)
    assert torch.isnan(out[1]).all() and torch.isfinite(out[0]).all()


@pytest.mark.parametrize(
    ("mode", "path", "more", "message"),
    [
        ("torsion", L, {}, "mode = 'torsion' is not known"),
        ("biaxial", L, {}, r"biaxial takes \(n, 2\)"),
        ("uniaxial", L - 1, {}, "stretches must be positive"),
        ("uniaxial", L, {"time": torch.zeros(6)}, "time must increase"),
        ("uniaxial", L, {"step": 0.0}, "step = 0.0 must be positive"),
    ],
)
def test_errors(mode, path, more, message):
    with pytest.raises(UserError, match=message):
        stress_along(rubber(), mode, path, **more)
    with pytest.raises(UserError, match="viscosity_shear depends on the rate: give the times"):
        stress_along(rubber(viscosity_shear=1.0), "uniaxial", L)
