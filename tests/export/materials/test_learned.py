"""Learned laws leave as TorchScript and C, and give the stresses of Python there."""

import ctypes
import shutil
import subprocess

import numpy as np
import pytest
import torch

from neuido.errors import UserError
from neuido.export.materials.c_header import write_c
from neuido.export.materials.learned import write_torchscript
from neuido.models import IntrinsicDynamicsOperator, save_law

pytestmark = pytest.mark.filterwarnings("ignore:.*torch.jit.*")
TRUNKS = ("raw", "objective", "bounded", "general")


def laws(trunk: str, dtype=torch.float32):
    torch.manual_seed(3)
    operator = IntrinsicDynamicsOperator(trunk, latent_dim=4, basis_dim=6, hidden_dim=16, head_dim=8, viscous=trunk == "general")
    operator = operator.to(dtype).requires_grad_(False)
    with torch.no_grad():
        for parameter in operator.parameters():
            parameter.mul_(2.0)  # outputs of order one, so that every term counts
        return operator.laws(torch.randn(4, dtype=dtype))


def gradients() -> torch.Tensor:
    """Near and far from I; the last is inverted."""
    generator = torch.Generator().manual_seed(1)
    F = torch.eye(3, dtype=torch.float64) + 0.15 * torch.randn(40, 3, 3, generator=generator, dtype=torch.float64)
    small = torch.eye(3, dtype=torch.float64) + 1e-3 * torch.randn(4, 3, 3, generator=generator, dtype=torch.float64)
    return torch.cat([F[torch.linalg.det(F) > 0.3], small, torch.diag(torch.tensor([1.1, 0.9, -0.4], dtype=torch.float64))[None]])


def close(got: np.ndarray, want: np.ndarray, tolerance: float) -> None:
    """Compare each matrix relative to its largest entry."""
    size = np.abs(want).max(axis=(1, 2), keepdims=True)
    assert float((np.abs(got - want) / size).max()) < tolerance


@pytest.mark.parametrize("trunk", TRUNKS)
def test_torchscript_gives_corrected_gradient_and_stress(trunk, tmp_path):
    elastic, plastic = laws(trunk)
    path = write_torchscript((elastic, plastic), tmp_path / "law.pt")
    F = gradients()
    corrected = plastic(F)
    loaded = torch.jit.load(str(path))
    got, tau = loaded(F)
    close(got.numpy(), corrected.numpy(), 1e-12)
    close(tau.numpy(), elastic(corrected).numpy(), 1e-10)
    single, _ = loaded(F[:3].float())
    assert single.dtype == torch.float32 and single.shape == (3, 3, 3)
    given = F.clone().requires_grad_()
    loaded(given)[1].sum().backward()
    assert bool(torch.isfinite(given.grad).all()) and float(given.grad.abs().max()) > 0


@pytest.fixture(scope="module")
def libraries(tmp_path_factory):
    """The header of each trunk, compiled without a warning."""
    if shutil.which("cc") is None:
        pytest.skip("no C compiler is installed")
    folder = tmp_path_factory.mktemp("c")
    for trunk in TRUNKS:
        write_c(laws(trunk), folder / f"{trunk}.h", name=trunk, tangent=True)
    body = "".join(
        f'#include "{t}.h"\n'
        f"void {t}_s(const double *F, double *o) {{ {t}_stress(F, o); }}\nvoid {t}_sf(const float *F, float *o) {{ {t}_stressf(F, o); }}\n"
        f"void {t}_c(const double *F, double *o) {{ {t}_corrected(F, o); }}\n"
        f"void {t}_cf(const float *F, float *o) {{ {t}_correctedf(F, o); }}\n"
        f"void {t}_t(const double *F, double *o) {{ {t}_tangent(F, o); }}\n"
        for t in TRUNKS
    )
    (folder / "all.c").write_text(body)
    words = ["cc", "-std=c99", "-O1", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC", "all.c", "-o", "all.so", "-lm"]
    made = subprocess.run(words, cwd=folder, capture_output=True, text=True)
    assert made.returncode == 0, made.stderr
    return ctypes.CDLL(str(folder / "all.so"))


def called(function, F: torch.Tensor, kind, size: int = 9) -> np.ndarray:
    rows = []
    for one in F.numpy():
        given, out = (kind * 9)(*one.reshape(-1)), (kind * size)()
        function(given, out)
        rows.append(np.array(out).reshape(size // 3 if size == 9 else 9, -1))
    return np.stack(rows)


@pytest.mark.parametrize("trunk", TRUNKS)
def test_c_agrees_with_python(trunk, libraries):
    elastic, plastic = laws(trunk)
    F = gradients()
    tau, corrected = elastic(F).numpy(), plastic(F).numpy()
    close(called(libraries[f"{trunk}_s"], F, ctypes.c_double), tau, 1e-10)
    close(called(libraries[f"{trunk}_c"], F, ctypes.c_double), corrected, 1e-12)
    close(called(libraries[f"{trunk}_cf"], F, ctypes.c_float), corrected, 1e-5)
    moderate = F[:-1][(F[:-1] - torch.eye(3)).abs().amax((1, 2)) > 0.05]
    close(called(libraries[f"{trunk}_sf"], moderate, ctypes.c_float), elastic(moderate).numpy(), 1e-5)


@pytest.mark.parametrize("trunk", TRUNKS)
def test_tangent_in_c_is_the_derivative(trunk, libraries):
    elastic, _ = laws(trunk)
    F = gradients()[:2]
    want = [torch.autograd.functional.jacobian(lambda f: elastic(f[None])[0], one).reshape(9, 9) for one in F]
    close(called(libraries[f"{trunk}_t"], F, ctypes.c_double, 81), torch.stack(want).numpy(), 1e-6)


def test_law_file_and_diagnosed_model_are_read(tmp_path):
    torch.manual_seed(0)
    operator = IntrinsicDynamicsOperator("objective", latent_dim=4, basis_dim=6, hidden_dim=16, head_dim=8)
    z = torch.randn(4)
    save_law(tmp_path / "law.safetensors", operator, z)
    model = "density: 1000\nelasticity: {law: neo_hookean, young: 1e4, poisson: 0.3}\nlaw: {file: law.safetensors, stiffness: 2.5}\n"
    (tmp_path / "found").mkdir()
    (tmp_path / "found" / "model_after.yaml").write_text(model.replace("law.safetensors", "../law.safetensors"))
    F = gradients()[:5]
    with torch.no_grad():
        elastic, plastic = operator.laws(z)
        corrected = plastic(F)
        want = elastic(corrected)
    for source, factor in ((tmp_path, 1.0), (tmp_path / "law.safetensors", 1.0), (tmp_path / "found", 2.5)):
        got = torch.jit.load(str(write_torchscript(source, tmp_path / "a.pt")))(F)[1]
        assert got.numpy() == pytest.approx(factor * want.numpy(), rel=1e-6, abs=1e-3)


@pytest.mark.parametrize(
    ("write", "words"),
    [
        (lambda folder: write_torchscript(laws("raw"), folder / "a.bin"), r"a TorchScript file ends in \.pt"),
        (lambda folder: write_c(laws("raw"), folder / "a.c"), r"a C header ends in \.h"),
        (lambda folder: write_c(laws("raw"), folder / "a.h", name="a b; int"), "starts with a letter"),
        (lambda folder: write_c((laws("raw")[0], laws("raw")[0]), folder / "a.h"), "give an elastic and a plastic law"),
        (lambda folder: write_c(folder / "none.safetensors", folder / "a.h"), "none.safetensors"),
    ],
)
def test_what_cannot_be_written_is_one_line(write, words, tmp_path):
    with pytest.raises(UserError, match=words):
        write(tmp_path)
    assert not list(tmp_path.iterdir())


def test_law_of_several_materials_is_refused(tmp_path):
    torch.manual_seed(0)
    operator = IntrinsicDynamicsOperator("objective", latent_dim=4, basis_dim=6, hidden_dim=16, head_dim=8)
    with torch.no_grad(), pytest.raises(UserError, match="of 2 materials"):
        write_c(operator.laws(torch.randn(2, 4)), tmp_path / "a.h")
