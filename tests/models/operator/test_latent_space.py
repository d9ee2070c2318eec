"""How the latents lie: silhouettes of spaces that are known, and steadiness of rows that are known; then the weights of the package."""

import builtins

import numpy as np
import pytest
import torch

from neuido.commands.main import main
from neuido.data.files.score_tables import read_rows
from neuido.errors import UserError
from neuido.models.operator import interpolation
from neuido.models.operator import latent_space as latents
from neuido.models.operator.dynamics_operator import PRETRAINED, IntrinsicDynamicsOperator
from neuido.models.operator.law_properties import p_wave_modulus


@pytest.fixture(scope="module", params=PRETRAINED)
def operator(request) -> IntrinsicDynamicsOperator:
    return IntrinsicDynamicsOperator.load(request.param)


def grouped(spread: float) -> IntrinsicDynamicsOperator:
    """An untrained operator with twelve latents of two families, four apart."""
    torch.manual_seed(0)
    made = IntrinsicDynamicsOperator(latent_dim=4, basis_dim=4, hidden_dim=8, head_dim=8)
    centres = torch.tensor([[4.0, 0, 0, 0], [0, 0, 0, 0]]).repeat_interleave(6, 0)
    made.set_latents(centres + spread * torch.randn(12, 4), [f"m{i}" for i in range(12)], ["a"] * 6 + ["b"] * 6)
    return made


def test_silhouette_of_groups_and_of_noise():
    pytest.importorskip("sklearn")
    apart, mixed = (latents.silhouettes(grouped(spread))[0] for spread in (0.05, 40.0))
    assert apart["space"] == "raw"
    assert apart["silhouette"] > 0.9
    assert apart["neighbours"] == 1.0
    assert abs(mixed["silhouette"]) < 0.2
    assert mixed["neighbours"] < 0.9


def test_one_family_has_no_silhouette():
    pytest.importorskip("sklearn")
    made = grouped(0.1)
    made.latent_families = ["a"] * 12
    with pytest.raises(UserError, match="families"):
        latents.silhouettes(made)


def test_the_prior_gathers_families():
    """The latents lie apart by family (goal: 0.3) where Stage I had the prior, and not without it."""
    pytest.importorskip("sklearn")
    found = {name: latents.silhouettes(IntrinsicDynamicsOperator.load(name))[0]["silhouette"] for name in PRETRAINED}
    expected = {"pretrained": 0.076, "pretrained-family": 0.611, "pretrained-bounded": 0.076, "pretrained-objective": 0.083,
                "pretrained-materials": 0.616}  # fmt: skip
    assert found == {name: pytest.approx(value, abs=0.005) for name, value in expected.items()}


def test_silhouettes_of_the_package(operator):
    """What the laws answer lies apart by family, with the prior and without it."""
    pytest.importorskip("sklearn")
    rows = {row["space"]: row for row in latents.silhouettes(operator)}
    assert set(rows) == set(latents.SPACES) - {"t-sne"}
    few = len(set(operator.latent_families)) == 3  # of eight families some answer alike: elastic, rubber and foam at small strain
    assert rows["laws"]["silhouette"] > (0.45 if few else 0.3)
    assert rows["plastic coefficients"]["silhouette"] > (0.4 if few else 0.35)
    assert rows["raw"]["neighbours"] > 0.95


@pytest.mark.parametrize(("name", "most"), [("pretrained-objective", 0.9), ("pretrained-family", 0.95)])
@pytest.mark.slow
def test_few_directions_are_felt(name, most):
    """Along most of the latents' variance nothing happens to the laws; the prior takes a part of what is idle."""
    pytest.importorskip("sklearn")
    two, forty = latents.active_directions(IntrinsicDynamicsOperator.load(name), kept=(2, 40))
    assert forty["law changes"] < 0.02 < two["law changes"]
    assert two["variance"] < 0.2 < forty["variance"] < most


def test_felt_directions_are_found():
    """Of a law that feels the first component of z alone, the first direction is that one."""
    made = grouped(0.5)
    for head in (made.elastic_head, made.plastic_head):
        head[0].weight.data[:, 1:] = 0.0
    V = latents._sensitive_directions(made, made.latents)
    assert torch.allclose(V.T @ V, torch.eye(4), atol=1e-5)
    assert V[0, 0].abs() > 0.999


def test_embedding(operator):
    pytest.importorskip("sklearn")
    made = grouped(0.1)
    rows = latents.tsne(made, perplexity=3.0)
    x = np.array([(row["x"], row["y"]) for row in rows])
    gap = np.linalg.norm(x[:6].mean(0) - x[6:].mean(0))
    assert gap > 2 * max(x[:6].std(0).max(), x[6:].std(0).max())
    assert rows == latents.tsne(made, perplexity=3.0)
    with pytest.raises(UserError, match="perplexity = 12"):
        latents.tsne(made, perplexity=12)


def test_monotonicity():
    up = interpolation.monotonicity([1, 2, 3, 4, 9])
    assert up == {"steps": 1.0, "spearman": pytest.approx(1.0), "back": 0.0}
    assert interpolation.monotonicity([9, 4, 3, 2, 1]) == up
    bent = interpolation.monotonicity([0, 2, 1, 4])
    assert bent["steps"] == pytest.approx(2 / 3)
    assert bent["spearman"] == pytest.approx(0.8)
    assert bent["back"] == pytest.approx(0.25)
    assert interpolation.monotonicity([1, 1, 1])["spearman"] == 0.0


@pytest.mark.parametrize("operator", [pytest.param(n, marks=[pytest.mark.slow] * (n != "pretrained")) for n in PRETRAINED], indirect=True)
def test_interpolation_is_softer_to_stiffer(operator):
    """The drop test of the package's weights: apparent stiffness is monotone between the softest and the stiffest elastic latent."""
    ends = interpolation.softest_and_stiffest(operator)
    assert ends == ("elastic-022", "elastic-040" if len(operator.latents) > 90 else "elastic-004")
    found = interpolation.interpolate(operator, ends, count=4)
    assert found.motion.shape[:2] == (interpolation.FRAMES, 4)
    assert found.motion.isfinite().all()
    for name, sign in (("modulus", 1), ("compression", -1), ("contact", -1)):
        values = sign * np.array([row[name] for row in found.rows])
        assert (np.diff(values) > 0).all(), name
    assert found.rows[0]["compression"] > 0.2 > 0.1 > found.rows[-1]["compression"] > 0
    end = p_wave_modulus(operator, operator.latent(ends[1])[None])
    assert found.rows[-1]["modulus"] == pytest.approx(float(end.detach()), rel=1e-4)


@pytest.mark.parametrize(
    "operator", [pytest.param(n, marks=[pytest.mark.slow] * (n == "pretrained-materials")) for n in PRETRAINED], indirect=True
)
def test_all_pairs(operator):
    found = interpolation.pairwise_monotonicity(operator, "sand", count=5)
    assert found["pairs"] > 300
    assert found["spearman"] > 0.9
    assert 0.5 < found["monotone"] <= 1.0


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (["--operator", "nowhere.safetensors"], "nowhere"),
        (["--parts", "[space, time]"], "time"),
        (["--parts", "[interpolation]", "--ends", "[jelly, gel]"], "gel"),
        (["--parts", "[interpolation]", "--count", "2"], "count = 2"),
        (["--parts", "[interpolation]", "--family", "foam"], "foam"),
    ],
)
def test_mistakes_are_one_line(tmp_path, capsys, options, word):
    with pytest.raises(SystemExit) as stop:
        main(["latents", "--out", str(tmp_path), *options])
    err = capsys.readouterr().err.strip()
    assert stop.value.code == 2
    assert len(err.splitlines()) == 1
    assert word in err


def test_without_scikit_learn(operator, monkeypatch):
    real = builtins.__import__

    def absent(name, *rest, **options):
        if name.startswith("sklearn"):
            raise ImportError(name)
        return real(name, *rest, **options)

    monkeypatch.setattr(builtins, "__import__", absent)
    with pytest.raises(UserError, match="pip install scikit-learn"):
        latents.silhouettes(operator)


@pytest.mark.slow
def test_command_writes_all(tmp_path, monkeypatch):
    pytest.importorskip("sklearn")
    monkeypatch.setattr(interpolation, "FRAMES", 31)
    with pytest.raises(SystemExit) as stop:
        main(["latents", "--out", str(tmp_path), "--count", "3", "--ends", "[jelly, elastic-004]"])
    assert stop.value.code == 0
    assert {path.name for path in tmp_path.iterdir()} == {
        "directions.csv", "embedding.csv", "embedding.png", "interpolation.csv", "interpolation.npz", "interpolation.png",
        "monotonicity.csv", "pairs.csv", "setup.json", "silhouettes.csv"}  # fmt: skip
    assert len(read_rows(tmp_path / "embedding.csv")) == 90
    assert [row["space"] for row in read_rows(tmp_path / "silhouettes.csv")] == list(latents.SPACES)
    assert [row["share"] for row in read_rows(tmp_path / "interpolation.csv")] == [0.0, 0.5, 1.0]
    with np.load(tmp_path / "interpolation.npz") as archive:
        assert archive["x"].shape[:2] == (31, 3)
