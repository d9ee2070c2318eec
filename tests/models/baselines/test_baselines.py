"""The peers: NCLaw's networks give the figures known of them (their weights are not in the repository), and each method fits a scene."""

import csv

import numpy as np
import pytest
import torch
from lightning.pytorch import Trainer, seed_everything

from neuido.errors import UserError
from neuido.models.baselines.known_law import PARTS, KnownLaw
from neuido.models.baselines.nclaw import NCLaw, NeuMA, load_nclaw, read_nclaw_weights
from neuido.models.baselines.sparse_law import SparseLaw
from neuido.models.baselines.spring_gaus import SpringMass, farthest_points, following
from neuido.models.baselines.stage_one_latents import MeanLatent, RandomLatent, UniPhy
from neuido.models.inference.pipeline import render_motion
from neuido.models.inference.prepared_scene import prepare
from neuido.models.stages.adapt import AdaptModule
from neuido.models.stages.image_module import image_losses
from neuido.physics.effects.parameters import Effects
from neuido.physics.laws.classical import FixedCorotated, Sigma
from tests.models.visual_samples import TinyScenes, tiny_scene


def deformations(count=2000):
    return torch.eye(3) + 0.01 * torch.randn(count, 3, 3, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize(
    ("name", "law", "error"),
    [("jelly", FixedCorotated(1e5, 0.2), 0.11), ("plasticine", Sigma(3e5, 0.25), 0.25), ("sand", Sigma(1e6, 0.2), 0.79)],
)
def test_distance_to_the_law_it_was_trained_on(data_root, name, law, error):
    elastic, plastic = load_nclaw(data_root / "peers" / f"nclaw-{name}.npz")
    F = deformations()
    want, got = law(F), elastic(F)
    assert ((got - want).norm() / want.norm()).item() == pytest.approx(error, abs=0.02)
    if name == "jelly":
        assert torch.cosine_similarity(got.flatten(), want.flatten(), dim=0).item() == pytest.approx(0.995, abs=0.003)
        assert (got.norm() / want.norm()).item() == pytest.approx(1.03, abs=0.02)
        assert elastic.modulus().item() == pytest.approx(law.modulus().item(), rel=0.2)


def test_frame_indifference_and_rest(data_root):
    elastic, plastic = load_nclaw(data_root / "peers" / "nclaw-jelly.npz")
    F = deformations(50).double()
    Q = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)))[0]
    Q = Q * Q.det()
    torch.testing.assert_close(elastic(Q @ F), Q @ elastic(F) @ Q.T, rtol=1e-6, atol=1e-4)
    torch.testing.assert_close(plastic(Q @ F), Q @ plastic(F), rtol=1e-9, atol=1e-10)
    rest = torch.eye(3, dtype=torch.float64)[None]
    assert elastic(rest).abs().max() == 0 and torch.equal(plastic(rest), rest)


@pytest.mark.parametrize("part", [0, 1])
def test_gradient_with_respect_to_F(data_root, part):
    law = load_nclaw(data_root / "peers" / "nclaw-plasticine.npz")[part]
    F = deformations(3).double().requires_grad_(True)
    assert torch.autograd.gradcheck(law, (F,), eps=1e-6, rtol=1e-4, atol=1e-4)


def test_missing_or_wrong_file(tmp_path):
    with pytest.raises(UserError, match="are missing"):
        load_nclaw(tmp_path / "nclaw-jelly.npz")
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(UserError, match="no array elasticity"):
        load_nclaw(tmp_path / "other.npz")


# The methods.

CLAY = {"law": "von_mises", "yield_stress": 3e3}
SAND = {"law": "drucker_prager", "friction_angle": 30.0}


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """Networks of NCLaw's shapes that make a soft isotropic solid, in its files' layout."""
    generator = torch.Generator().manual_seed(0)
    folder = tmp_path_factory.mktemp("peers")
    for name in ("jelly", "plasticine", "sand"):
        arrays = {}
        for part, scale in zip(PARTS, (1.0, 0.02)):
            first, second, last = torch.zeros(64, 13), torch.zeros(64, 64), torch.zeros(9, 64)
            for i, k in enumerate((0, 4, 8)):  # gelu(x) - gelu(-x) = x, twice: a strain through two layers
                first[2 * i, 3 + k], first[2 * i + 1, 3 + k] = 1.0, -1.0
                second[2 * i, 2 * i], second[2 * i, 2 * i + 1] = 1.0, -1.0
                second[2 * i + 1, 2 * i], second[2 * i + 1, 2 * i + 1] = -1.0, 1.0
                last[k, 2 * i], last[k, 2 * i + 1] = 1.0, -1.0
            size = scale * 40.0  # in each layer alike: 6.4e4 Pa in all
            layers = [size * (W + 0.01 * torch.randn(W.shape, generator=generator)) for W in (first, second, last)]
            arrays |= {f"{part}.{layer}": W.numpy() for layer, W in zip(("layers.0.fc", "layers.1.fc", "final_layer.fc"), layers)}
        np.savez(folder / f"nclaw-{name}.npz", **arrays)
    return str(folder)


def filmed(scene, method):
    """The scene as its own pipeline shows it under the law that the method starts with."""
    prepared = prepare(scene, None)
    with torch.no_grad():
        images, alphas = render_motion(
            prepared, method.for_scene(prepared).rollout(prepared, prepared.frames), list(range(len(prepared.images)))
        )
    images = images.transpose(0, 1).clamp(0, 1).contiguous()
    return scene._replace(batch=scene.batch._replace(images=images, masks=alphas.transpose(0, 1).contiguous()))


def fit(method, scene, steps):
    """The losses of so many steps as `AdaptModule` takes them, and the fitted copy."""
    prepared = prepare(scene, None)
    own = method.for_scene(prepared)
    groups = own.parameter_groups()
    optimizer = own.optimizer(groups)
    rates, losses = [group["lr"] for group in groups], []
    for step in range(steps):
        for group, rate in zip(optimizer.param_groups, rates):
            group["lr"] = rate * own.rate(step / steps)
        optimizer.zero_grad()
        loss, silhouette = image_losses(prepared, own.rollout(prepared, prepared.frames), prepared.training_views)
        (loss + 0.1 * silhouette + own.regulariser()).backward()
        torch.nn.utils.clip_grad_norm_(list(own.trainable().values()), 1.0)
        optimizer.step()
        losses.append(float(loss.detach()))
    return losses, own


@pytest.mark.parametrize(
    ("name", "truth", "start", "plasticity", "tolerance"),
    [
        ("young", 5e4, 1.5e5, None, 0.02),
        ("poisson", 0.35, 0.2, None, 0.03),
        ("yield_stress", 3e3, 1e3, CLAY, 0.03),
        ("friction_angle", 30.0, 15.0, SAND, 0.05),
        ("viscosity", 200.0, 60.0, None, 0.1),
    ],
)
@pytest.mark.slow
def test_a_known_law_finds_its_parameter(tmp_path, name, truth, start, plasticity, tolerance):
    true = {"young": 5e4, "poisson": 0.25, "yield_stress": 3e3, "friction_angle": 30.0, name: truth}
    shape = "box" if plasticity == SAND else "ball"
    scene = filmed(tiny_scene(tmp_path, young=5e4, plasticity=plasticity, shape=shape), KnownLaw(**true))
    rates = {"poisson": 0.03, "friction_angle": 2.0, "viscosity": 0.1}
    losses, own = fit(KnownLaw(**{**true, name: start}, free_parameters=[name], rates=rates), scene, 35)
    assert own.describe()[name] == pytest.approx(truth, rel=tolerance)
    assert losses[-1] < 0.05 * losses[0]
    assert len(own.trainable()) == 1


def test_a_law_is_told_with_units(tmp_path):
    prepared = prepare(tiny_scene(tmp_path, plasticity=SAND), None)
    own = KnownLaw(young=5e4, poisson=0.25, friction_angle=30.0).for_scene(prepared)
    for words in ("drucker_prager", "young = 50 kPa", "poisson = 0.25", "friction_angle = 30 degrees"):
        assert words in own.summary()


SPRINGS = {"anchors": 60, "neighbours": 12, "full_stiffness_neighbours": 4, "binding": 6, "stiffness_rate": 0.05}
METHODS = {
    "known": (lambda weights: KnownLaw(young=2e5), 12, 0.5),
    "neuma": (lambda weights: NeuMA(weights, elastic_rate=2.0), 16, 0.8),
    "uniphy": (lambda weights: UniPhy(), 12, 0.7),
    "springs": (lambda weights: SpringMass(**SPRINGS), 12, 0.95),
    "sparse": (lambda weights: SparseLaw(young=2e5, interval=5, rounds=1, stiffness_rate=0.1), 14, 0.7),
}


def module(tmp_path, method, **options):
    seed_everything(0)
    return AdaptModule(method, **{"curriculum": [], "views_per_step": 0, "out": str(tmp_path / "out"), **options})


def trainer(tmp_path):
    options = {"logger": False, "enable_checkpointing": False, "num_sanity_val_steps": 0, "limit_val_batches": 0, "max_epochs": -1}
    options |= {"enable_progress_bar": False, "enable_model_summary": False, "gradient_clip_val": 1.0}
    return Trainer(accelerator="cpu", default_root_dir=tmp_path, **options)


def rows_of(path):
    return list(csv.DictReader(path.open()))


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.slow
def test_a_method_is_fitted_scored_and_read_back(tmp_path, weights, name):
    build, steps, share = METHODS[name]
    data = TinyScenes(str(tmp_path), youngs=(5e4,))
    model = module(tmp_path, build(weights), steps=steps)
    losses, step = [], model.training_step
    model.training_step = lambda *a: losses.append(step(*a)) or losses[-1]
    trainer(tmp_path).fit(model, data)
    losses = [float(loss.detach()) for loss in losses]
    assert len(losses) == steps and losses[-1] < share * losses[0]
    before, after = rows_of(tmp_path / "out" / "scores.csv")
    assert (before["stage"], after["stage"]) == ("before", "after") and float(after["psnr"]) > float(before["psnr"])
    for column in ("cd", "floor", "rmse", "psnr", "ssim", "steps", "seconds"):
        assert float(after[column]) > 0
    trainer(tmp_path).test(module(tmp_path, build(weights), adapter=str(tmp_path / "out")), data, verbose=False)
    (tested,) = rows_of(tmp_path / "out" / "test.csv")
    assert float(tested["cd"]) == pytest.approx(float(after["cd"]), rel=1e-4)


@pytest.mark.parametrize(
    "build", [lambda w: NCLaw(w), lambda w: MeanLatent(), lambda w: RandomLatent(), lambda w: RandomLatent(distribution="trained")]
)
def test_what_learns_nothing_is_scored(tmp_path, weights, build):
    trainer(tmp_path).fit(module(tmp_path, build(weights)), TinyScenes(str(tmp_path), youngs=(5e4,)))
    (row,) = rows_of(tmp_path / "out" / "scores.csv")
    assert row["stage"] == "before" and float(row["cd"]) > 0 and float(row["found_modulus"]) > 0


def test_neuma_begins_as_nclaw_and_changes_every_layer(tmp_path, weights):
    prepared = prepare(tiny_scene(tmp_path, plasticity=CLAY), None)
    plain, tuned = (method.for_scene(prepared) for method in (NCLaw(weights), NeuMA(weights)))
    assert plain.describe() == tuned.describe() and plain.describe()["base"] == "plasticine"
    for a, b in zip(plain.laws(prepared), tuned.laws(prepared)):
        assert all(torch.equal(x, y) for x, y in zip(a.tensors(), b.tensors()))
    assert sum(p.numel() for p in tuned.trainable().values()) == 2 * 16 * (13 + 64 + 64 + 64 + 64 + 9)
    assert [group["lr"] for group in tuned.parameter_groups()] == [0.02, 0.002]
    assert tuned.rate(0.0) == pytest.approx(1.0) and tuned.rate(1.0) == pytest.approx(0.01)
    with torch.no_grad():
        for layer in tuned.lora["elasticity"]:
            layer.B += 0.1
    given, _ = read_nclaw_weights(f"{weights}/nclaw-plasticine.npz")
    for W, base, layer in zip(tuned.laws(prepared)[0].tensors(), given, tuned.lora["elasticity"]):
        torch.testing.assert_close(W[0], base + 0.1 * layer.A.sum(0, keepdim=True))  # alpha / r = 1


def test_sparse_law_drops_what_does_not_count(tmp_path):
    prepared = prepare(tiny_scene(tmp_path), None)
    law = SparseLaw(yields="yes").for_scene(prepared)
    with torch.no_grad():
        law.shape[2, 3], law.shape[3, 2] = 1e-4, 0.8
    F = torch.eye(3) + 0.1 * torch.randn(500, 3, 3, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        law.surface[0] = 5.0
    before = law.coefficients()
    assert {"cohesion", "friction", "expansion"} - law.describe().keys() == {"cohesion"}
    law.select_terms(F)
    assert torch.equal(law.coefficients(), before)  # nothing happens before the next run
    law.prune_terms()
    after = law.coefficients()
    assert after[2, 3] == 0 and after[3, 2] == before[3, 2] and after[1, 0] == before[1, 0]
    assert float(law.surface[0]) == 9.0  # no strain reaches it: there is no yield
    assert "cohesion" not in law.describe() and law.describe()["terms"] == 3
    assert "q (A:A)/q I" in law.describe()["stress_kPa"]
    again = SparseLaw(yields="yes").for_scene(prepared)
    again.load_state_dict(law.state_dict())  # what a checkpoint keeps
    assert again.describe() == law.describe()


def test_springs_have_the_modulus_that_they_are_given(tmp_path):
    """A uniform expansion by e stores W = 3 E e^2 V in a body of E, Poisson's ratio 1/4."""
    prepared = prepare(tiny_scene(tmp_path), None)
    springs = SpringMass(anchors=80, neighbours=20, power=0.0, young=7e4).for_scene(prepared)
    assert springs.describe()["young"] == pytest.approx(7e4, rel=1e-5)
    stiffness, e = springs.springs()[0].detach().double(), 1e-3
    energy = 0.5 * (stiffness * (e * springs.body.rest.double()).square()).sum()
    assert float(energy) == pytest.approx(3 * 7e4 * e**2 * float(prepared.simulator.volume.sum()), rel=1e-5)


def test_anchors_and_what_follows_them():
    x = torch.rand(200, 3, generator=torch.Generator().manual_seed(0))
    index = farthest_points(x, 20)
    assert len(set(index.tolist())) == 20 and len(farthest_points(x, 500)) == 200
    reach = torch.cdist(x, x[index]).min(1).values.max()
    assert reach < torch.cdist(x, x[:20]).min(1).values.max()
    weights = following(x, x[index], 4).to_dense()
    torch.testing.assert_close(weights.sum(1), torch.ones(200))
    torch.testing.assert_close(weights[index], torch.eye(20), rtol=0, atol=1e-4)  # an anchor follows itself


def test_impossible_options_are_named(tmp_path, weights, monkeypatch):
    monkeypatch.delenv("NEUIDO_DATA", raising=False)
    scene = prepare(tiny_scene(tmp_path), None)
    for build, words in (
        (lambda: KnownLaw(young=-1.0), "young = -1"),
        (lambda: KnownLaw(poisson=0.5), "poisson = 0.5"),
        (lambda: KnownLaw(free_parameters=["viscosity"]), "no parameter 'viscosity'"),
        (lambda: KnownLaw(rates={"stiffness": 1.0}), "no parameter 'stiffness'"),
        (lambda: NeuMA(weights, rank=0), "rank = 0"),
        (lambda: NeuMA(weights, alpha=0.0), "alpha = 0"),
        (lambda: NCLaw(str(tmp_path / "nowhere")).for_scene(scene), "are missing"),
        (lambda: NCLaw().for_scene(scene), "model.method.weights: give"),
        (lambda: UniPhy(lr=0.0), "lr = 0"),
        (lambda: UniPhy(operator="nowhere.safetensors"), "nowhere.safetensors are missing"),
        (lambda: SpringMass(anchors=1), "anchors = 1: at least 2"),
        (lambda: SpringMass(neighbours=0), "neighbours = 0: at least 1"),
        (
            lambda: SpringMass(anchors=8, neighbours=4).for_scene(scene).rollout(scene, 2, effects=Effects(drag_linear=1.0)),
            "takes no effects",
        ),
        (lambda: SparseLaw(threshold=1.5), "threshold = 1.5"),
        (lambda: SparseLaw(interval=0), "interval = 0"),
    ):
        with pytest.raises(UserError, match=words) as stop:
            build()
        assert "\n" not in str(stop.value)
