"""Few-shot adaptation: it improves what was held out, scene after scene, and a killed run goes on where it was."""

import itertools
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from lightning.pytorch import Trainer, seed_everything
from lightning.pytorch.callbacks import LambdaCallback
from safetensors.torch import load_file

from neuido.errors import UserError
from neuido.models.baselines.known_law import KnownLaw
from neuido.models.fewshot.fit_progress import RATE_RECOVERY, Progress
from neuido.models.fewshot.low_rank import LowRankAdaptation
from neuido.models.fewshot.method import Method
from neuido.models.fewshot.relative_density import RelativeDensity, lattice
from neuido.models.fewshot.scene_fit import SceneFit
from neuido.models.inference.prepared_scene import EffectSource, prepare
from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
from neuido.models.stages.adapt import AdaptModule
from neuido.models.stages.image_module import image_losses
from neuido.physics.effects.parameters import Effects
from tests.models.stages.adaptation_runs import finish, kill_after, losses, rows_of, start
from tests.models.visual_samples import TinyScenes, tiny_scene


def module(tmp_path, *, start="mean", **options):
    seed_everything(0)
    method = options.pop("method", None) or LowRankAdaptation(start=start, latent_lr=0.03)
    return AdaptModule(method, **{"steps": 12, "curriculum": [], "out": str(tmp_path / "out"), **options})


def trainer(tmp_path, **options):
    options = {"logger": False, "enable_checkpointing": False, "num_sanity_val_steps": 0, "limit_val_batches": 0, **options}
    options = {"max_epochs": -1, "gradient_clip_val": 1.0, **options}
    return Trainer(accelerator="cpu", default_root_dir=tmp_path, enable_progress_bar=False, enable_model_summary=False, **options)


@pytest.mark.slow
def test_scenes_one_after_the_other(tmp_path):
    data = TinyScenes(str(tmp_path), youngs=(1e5, 2e5))  # both stiffer than the mean latent, which is at some 40 kPa
    model = module(tmp_path)
    frozen = IntrinsicDynamicsOperator.load().state_dict()
    seen = []
    step = model.training_step
    model.training_step = lambda batch, batch_idx: seen.append(batch.name) or step(batch, batch_idx)
    trainer(tmp_path).fit(model, data)
    assert seen == ["tiny-0"] * 12 + ["tiny-1"] * 12
    rows = rows_of(tmp_path / "out" / "scores.csv")
    assert [(row["scene"], row["stage"]) for row in rows] == [(f"tiny-{i}", stage) for i in (0, 1) for stage in ("before", "after")]
    for before, after in (rows[:2], rows[2:]):
        assert float(after["psnr"]) > float(before["psnr"]) + 1 and float(after["cd"]) < 0.7 * float(before["cd"])
        assert after["method"] == "LowRankAdaptation" and int(after["steps"]) == 12 and float(after["seconds"]) > 0
        assert float(before["found_latent_moved"]) == 0 < float(after["found_latent_moved"])
    images = rows_of(tmp_path / "out" / "tiny-0" / "after" / "images.csv")
    assert {row["view"] for row in images} == {"2"}  # the one that is held out
    assert "lpips" not in rows[0]  # absent, not zero
    found = model.fit_of("tiny-0").method.tuned.unload().state_dict()
    assert all(torch.equal(found[name], value) for name, value in frozen.items())

    # what was written scores the same, and predicts
    again = module(tmp_path, adapter=str(tmp_path / "out"))
    trainer(tmp_path).test(again, data, verbose=False)
    tested = rows_of(tmp_path / "out" / "test.csv")
    expected = [float(row["cd"]) for row in rows if row["stage"] == "after"]
    assert [float(row["cd"]) for row in tested] == pytest.approx(expected, rel=1e-4)
    one = module(tmp_path, adapter=str(tmp_path / "out" / "tiny-1" / "fit"), out=str(tmp_path / "other"))  # one scene's, for both
    answers = trainer(tmp_path).predict(one, data)
    assert [Path(answer["folder"]).name for answer in answers] == ["tiny-0", "tiny-1"]
    assert len(list((tmp_path / "other" / "tiny-0" / "particles").glob("*.ply"))) == 6
    assert (tmp_path / "other" / "tiny-0" / "prediction.mp4").is_file()


def test_curriculum_and_frames_of_the_fit(tmp_path):
    model = module(tmp_path, steps=10, curriculum=[0.5, 0.75], curriculum_share=0.4, fit_frames=4)
    prepared = prepare(tiny_scene(tmp_path), None)
    assert [model.rollout_frames(prepared, step) for step in range(6)] == [2, 2, 3, 3, 4, 4]
    fit = SceneFit(LowRankAdaptation(start="jelly").for_scene(prepared), False)
    with torch.no_grad():
        scored = model.score(prepared, fit, "before")
    late = [row for row in rows_of(tmp_path / "out" / "tiny" / "before" / "particles.csv") if int(row["frame"]) >= 4]
    assert scored["later_cd"] == pytest.approx(sum(float(row["cd"]) for row in late) / len(late), rel=1e-4)


@pytest.mark.slow
def test_silhouettes_alone(tmp_path):
    """Colours that say nothing do not matter where they have no weight."""
    scene = tiny_scene(tmp_path, young=2e5)
    noise = torch.rand(scene.batch.images.shape, generator=torch.Generator().manual_seed(0))
    data = TinyScenes(str(tmp_path))
    data.scenes = [scene._replace(batch=scene.batch._replace(images=noise), gaussians=None)]
    trainer(tmp_path).fit(module(tmp_path, image_weight=0.0, silhouette_weight=1.0), data)
    before, after = rows_of(tmp_path / "out" / "scores.csv")
    assert float(after["iou"]) > float(before["iou"]) + 0.02 and float(after["rmse"]) < 0.8 * float(before["rmse"])


@pytest.mark.slow
def test_velocity_is_estimated_from_the_first_frames(tmp_path):
    scene = tiny_scene(tmp_path, young=1e5, poisson=0.2, velocity=(0.8, -1.5, 0.3), spin=(0.0, 0.0, 0.0))  # jelly
    body = scene.body._replace(v=torch.zeros_like(scene.body.v))
    data = TinyScenes(str(tmp_path))
    data.scenes = [scene._replace(body=body)]
    options = {"estimate_velocity": True, "velocity_steps": 40, "velocity_frames": 4, "velocity_lr": 0.3, "steps": 2}
    model = module(tmp_path, start="jelly", **options)
    trainer(tmp_path).fit(model, data)
    linear, _ = model.fit_of("tiny").twist.detach()
    assert torch.allclose(linear, torch.tensor([0.8, -1.5, 0.3]), atol=0.15), linear
    again = module(tmp_path, start="jelly", adapter=str(tmp_path / "out"), **options)
    _, loaded = again.load_fit(data.scenes[0])
    assert torch.equal(loaded.twist, model.fit_of("tiny").twist)


@pytest.mark.slow
def test_an_uneven_filling_is_found(tmp_path):
    """A body whose upper half is heavier, of a known law: what its first frame does not show is read from its motion."""

    def uneven(x):
        factor = torch.where(x[:, 1] > x[:, 1].mean(), 3.0, 0.5)
        return factor / factor.mean()

    scene = tiny_scene(tmp_path, young=5e4, frames=10, every=10, density=uneven)
    true = uneven(scene.body.x)
    data = TinyScenes(str(tmp_path))
    data.scenes = [scene]
    known = {"method": KnownLaw(young=5e4, free_parameters=["young"], rates={"young": 1e-6}), "steps": 40, "views_per_step": 0}
    trainer(tmp_path).fit(module(tmp_path, out=str(tmp_path / "even"), **known), data)
    model = module(tmp_path, estimate_density=True, density_lr=0.1, **known)
    trainer(tmp_path).fit(model, data)
    before, after = rows_of(tmp_path / "out" / "scores.csv")
    assert float(after["rmse"]) < 0.4 * float(before["rmse"]) and float(before["found_density_spread"]) == 0
    assert float(rows_of(tmp_path / "even" / "scores.csv")[-1]["rmse"]) > 0.9 * float(before["rmse"])
    found = model.fit_of("tiny").density().detach()
    assert float(torch.corrcoef(torch.stack([found, true]))[0, 1]) > 0.6
    again = module(tmp_path, adapter=str(tmp_path / "out"), **known)  # what was fitted is kept, whatever the option says
    _, loaded = again.load_fit(scene)
    assert torch.equal(loaded.density(), found)
    _, plain = module(tmp_path, adapter=str(tmp_path / "even"), estimate_density=True, **known).load_fit(scene)
    assert float(plain.density().detach().std()) == 0


@pytest.mark.parametrize(("since", "moved"), [(0.0, True), (0.5, True), (1.0, False)])
@pytest.mark.slow
def test_a_density_waits_for_its_share_of_the_steps(tmp_path, since, moved):
    data = TinyScenes(str(tmp_path))
    model = module(tmp_path, estimate_density=True, density_from=since, steps=4, curriculum=[])
    seen = []
    watch = LambdaCallback(on_train_batch_start=lambda *_: seen.append(float(model.fits[0].density().detach().std())))
    trainer(tmp_path, callbacks=[watch]).fit(model, data)
    waited = min(4, round(4 * since) + 1)
    assert seen[:waited] == [0.0] * waited
    assert (float(model.fits[0].density().detach().std()) > 0) is moved


def test_a_density_is_a_smooth_field_of_mean_one():
    x = torch.rand(200, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    index, weight, size = lattice(x, 0.3)
    assert int(index.max()) < size and torch.allclose(weight.sum(1), torch.ones(200, dtype=torch.float64))
    nodes = torch.zeros(size, 3, dtype=torch.float64)
    shape = torch.tensor([int(v) + 2 for v in ((x - x.amin(0)) / 0.3).floor().amax(0)])
    for n in range(size):
        nodes[n] = x.amin(0) + 0.3 * torch.tensor([n // (shape[1] * shape[2]), n // shape[2] % shape[1], n % shape[2]])
    assert torch.allclose((nodes[index] * weight[..., None]).sum(1), x)  # what is linear is met
    volume = torch.linspace(1.0, 2.0, 200, dtype=torch.float64)
    field = RelativeDensity(x, volume, 0.1)
    assert torch.equal(field(), torch.ones(200, dtype=torch.float64)) and float(field.prior().detach()) == 0
    with torch.no_grad():
        for part in field.fields:
            part.normal_(0.0, 3.0, generator=torch.Generator().manual_seed(1))
    factor = field()
    assert float((factor * volume).sum().detach()) == pytest.approx(float(volume.sum())) and float(factor.detach().min()) > 0
    assert float(field.prior().detach()) > 0


def test_the_density_of_another_body_is_refused(tmp_path):
    x = torch.rand(50, 3)
    RelativeDensity(x, torch.ones(50), 0.2).save(tmp_path / "density.safetensors")
    with pytest.raises(UserError, match="of another body"):
        RelativeDensity(3 * x, torch.ones(50), 0.2).load(tmp_path / "density.safetensors")


class Drag(EffectSource):
    def of(self, scene):
        return Effects(drag_linear=3.0)


def test_effects_act_on_top_of_the_law(tmp_path):
    scene = tiny_scene(tmp_path)
    model = module(tmp_path, start="jelly", effects=Drag())
    prepared, fit = model.load_fit(scene)
    with torch.no_grad():
        moved = fit.rollout(prepared, prepared.frames)
        steps = prepared.substeps(prepared.frames)
        expected = prepared.simulator.rollout(steps, *fit.method.laws(prepared), every=prepared.every, effects=Effects(drag_linear=3.0))
        free = fit.method.rollout(prepared, prepared.frames)
    assert torch.equal(moved.x, expected.x) and not torch.allclose(moved.x, free.x, atol=1e-3)


def test_start_is_a_rigid_motion(tmp_path):
    prepared = prepare(tiny_scene(tmp_path, velocity=(0.0, 0.0, 0.0), spin=(0.0, 0.0, 0.0)), None)
    fit = SceneFit(LowRankAdaptation(start="jelly").for_scene(prepared), True)
    with torch.no_grad():
        fit.twist.copy_(torch.tensor([[1.0, 2.0, 3.0], [0.5, -1.0, 2.0]]))
        state = fit.start(prepared.simulator)
    x, v = state.x.double(), state.v.double()
    arm = x - x.mean(0)
    assert torch.allclose(v, torch.tensor([1.0, 2.0, 3.0]) + torch.linalg.cross(torch.tensor([[0.5, -1.0, 2.0]]).double(), arm), atol=1e-5)
    assert torch.allclose(state.C[0] @ arm[0].float(), (v[0] - v.mean(0)).float(), atol=1e-5)


@pytest.mark.slow
def test_early_stop_keeps_the_best(tmp_path, monkeypatch):
    values = itertools.chain([1.0, 0.5, 0.7, 0.6], itertools.repeat(0.9))
    model = module(tmp_path, stop_on="view", check_every=2, patience=4, steps=20)
    kept = []

    def record_loss(self, value, fit, patience):
        Progress.original(self, next(values), fit, patience)
        kept.append(fit.method.z.detach().clone())

    monkeypatch.setattr(Progress, "original", Progress.record_loss, raising=False)
    monkeypatch.setattr(Progress, "record_loss", record_loss)
    trainer(tmp_path).fit(model, TinyScenes(str(tmp_path), youngs=(5e4, 6e4)))
    assert model._progress["tiny-0"].steps == 8  # the lowest at step 4, and none lower until step 8
    assert torch.equal(model.fit_of("tiny-0").method.z, kept[1])
    assert len(rows_of(tmp_path / "out" / "scores.csv")) == 4


@pytest.mark.slow
def test_a_step_into_a_law_that_cannot_run_is_undone(tmp_path, capsys):
    model = module(tmp_path, steps=4, start="jelly")
    step = model.optimizer_step

    def thrown(*arguments):
        step(*arguments)
        if model._progress["tiny-0"].steps == 2:
            with torch.no_grad():
                model.fit_of("tiny-0").method.z += 60.0

    model.optimizer_step = thrown
    trainer(tmp_path).fit(model, TinyScenes(str(tmp_path), youngs=(5e4,)))
    assert "tiny-0:" in capsys.readouterr().err
    assert model._progress["tiny-0"].damping == 0.5 * RATE_RECOVERY**2
    after = rows_of(tmp_path / "out" / "scores.csv")[-1]
    assert after["stage"] == "after" and float(after["psnr"]) > 20


def test_parameters_at_the_edge_of_what_runs_are_left():
    """The last ones that ran help nobody whose next step fails again: halfway back to the first ones, and the rates recover."""
    fit, progress = torch.nn.Linear(1, 1, bias=False), Progress()

    def put(value, runs):
        fit.weight.data.fill_(value)
        if runs:
            progress.record_success(fit)
        else:
            assert progress.restore_last_good(fit)
        progress.steps += 1
        return float(fit.weight.detach())

    assert not progress.restore_last_good(fit)  # nothing has run yet
    progress = Progress()
    put(0.0, True)
    put(1.0, True)
    assert put(1.01, False) == 1.0
    put(1.0, True)
    assert put(1.001, False) == 1.0
    assert put(1.001, False) == 0.5
    assert put(0.6, False) == 0.25
    assert progress.damping == pytest.approx(0.0625 * RATE_RECOVERY)
    for _ in range(50):
        put(0.9, True)
    assert progress.damping == 1.0
    assert put(1.0, False) == pytest.approx(0.9)
    # a gradient that is not finite may be one step's; the next one is not
    progress.steps += 20
    put(0.8, True)
    before = progress.damping
    assert progress.restore_last_good(fit, ran=True) and float(fit.weight.detach()) == pytest.approx(0.8)
    assert progress.restore_last_good(fit, ran=True) and progress.damping == before
    assert progress.restore_last_good(fit, ran=True) and float(fit.weight.detach()) == pytest.approx(0.4)


def test_a_gradient_that_is_not_finite_changes_nothing(tmp_path):
    model = module(tmp_path, start="jelly")
    p = torch.nn.Parameter(torch.ones(3))
    p.grad = torch.tensor([1.0, float("nan"), 2.0])
    model.on_before_optimizer_step(torch.optim.SGD([p], lr=1.0))
    assert torch.equal(p.grad, torch.zeros(3))


class Nothing(Method):
    """A law that is given."""

    steps = 0

    def laws(self, scene):
        operator = IntrinsicDynamicsOperator.load()
        return operator.laws(operator.latent("jelly"))


class Still(Method):
    """No law: the body falls as a point, at a height that is fitted; it stands for simulations of other kinds."""

    lr = 0.05

    def build(self, scene):
        self.pull = torch.nn.Parameter(torch.tensor(0.0))

    def rollout(self, scene, frames, *, state=None, effects=None, segment=0):
        start = scene.simulator.state
        t = torch.arange(frames) * (scene.every * scene.source.scene.dt)
        x = start.x + t[:, None, None] * start.v + 0.5 * t.square()[:, None, None] * self.pull * start.x.new_tensor([0.0, -1.0, 0.0])
        return type(start)(x, *(s.expand(frames, *s.shape) for s in start[1:]))

    def describe(self):
        return {"pull": float(self.pull.detach())}


@pytest.mark.slow
def test_methods_without_parameters_or_without_laws(tmp_path):
    data = TinyScenes(str(tmp_path), youngs=(5e4,))
    trainer(tmp_path).fit(module(tmp_path, method=Nothing(), steps=None), data)
    (row,) = rows_of(tmp_path / "out" / "scores.csv")
    assert (row["method"], row["stage"]) == ("Nothing", "before") and float(row["cd"]) > 0
    assert module(tmp_path, method=Nothing(), adapter=str(tmp_path / "out")).load_fit(data.scenes[0])
    model = module(tmp_path, method=Still(), out=str(tmp_path / "still"), fit_frames=2)
    trainer(tmp_path).fit(model, data)
    before, after = rows_of(tmp_path / "still" / "scores.csv")
    assert 0 < float(after["found_pull"]) < 10 and float(before["found_pull"]) == 0
    assert set(load_file(tmp_path / "still" / "tiny-0" / "fit" / "parameters.safetensors")) == {"pull"}
    again = module(tmp_path, method=Still(), adapter=str(tmp_path / "still"))
    assert torch.equal(again.load_fit(data.scenes[0])[1].method.pull, model.fit_of("tiny-0").method.pull)
    with pytest.raises(UserError, match="of the method 'Still'"):
        module(tmp_path, adapter=str(tmp_path / "still")).load_fit(data.scenes[0])


@pytest.mark.parametrize("segment", [0, 2])
def test_uneven_frames_and_segments(tmp_path, segment):
    scene = tiny_scene(tmp_path, frames=4)
    times = scene.batch.times + torch.tensor([0.0, 4e-3, -3e-3, 0.0])
    prepared = prepare(scene._replace(batch=scene.batch._replace(times=times)), None)
    assert prepared.every == 1 and prepared.recorded_frames == (0, 17, 28, 45)
    method = LowRankAdaptation(start="jelly").for_scene(prepared)
    motion = method.rollout(prepared, 4, segment=segment)
    with torch.no_grad():
        whole = prepared.simulator.rollout(45, *method.laws(prepared))
    assert torch.allclose(motion.x, whole.x[[0, 17, 28, 45]], atol=1e-6)
    image_losses(prepared, motion, [0])[0].backward()
    assert float(method.z.grad.abs().max()) > 0
    relative, plain = (image_losses(prepared, motion, [0], loss) for loss in ("relative", "mse"))
    recorded = prepared.recorded([0], 4)
    assert float(plain[0]) == pytest.approx(float(relative[0]) * (float((recorded - recorded[:1]).square().mean()) + 1e-6), rel=1e-5)


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"steps": -1}, "steps"),
        ({"fit_frames": 1}, "fit_frames"),
        ({"image_weight": 0.0, "silhouette_weight": 0.0}, "silhouette_weight"),
        ({"curriculum": [2.0]}, "curriculum"),
        ({"curriculum_share": 1.5}, "curriculum_share"),
        ({"density_from": 1.5}, "density_from"),
        ({"patience": 0}, "patience"),
        ({"segment": -1}, "segment"),
        ({"image_weight": float("nan")}, "image_weight"),
    ],
)
def test_impossible_options_are_named(tmp_path, options, word):
    with pytest.raises(UserError, match=word):
        module(tmp_path, **options)


def test_impossible_runs_are_named(tmp_path):
    data = TinyScenes(str(tmp_path), youngs=(5e4,))
    with pytest.raises(UserError, match="nowhere"):
        trainer(tmp_path).test(module(tmp_path, adapter=str(tmp_path / "nowhere")), data)
    scene = data.scenes[0]
    held = scene.batch.held_out.clone()
    held[1] = True
    data.scenes = [scene._replace(batch=scene.batch._replace(held_out=held))]
    with pytest.raises(UserError, match="stop_on"):
        trainer(tmp_path).fit(module(tmp_path, stop_on="view"), data)
    interval = float(scene.batch.times[1] - scene.batch.times[0])
    fine = replace(scene.scene, dt=0.0171)
    steps = interval / prepare(scene._replace(scene=fine), None).source.scene.dt
    assert steps == pytest.approx(round(steps)), "the step adapts to the frame rate"


@pytest.mark.slow
def test_a_killed_run_goes_on_where_it_was(tmp_path):
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    finish(start(whole))
    last = str(broken / "last.ckpt")
    kill_after(start(broken, pause=0.6), broken, 4)  # after the first scene's last step, before its scores
    kill_after(start(broken, pause=0.6, resume=last), broken, 6)
    finish(start(broken, resume=last))
    expected, resumed = losses(whole), losses(broken)
    assert expected.keys() == resumed.keys()
    for key, loss in expected.items():
        assert resumed[key] == pytest.approx(loss, rel=1e-5), key
    tables = [rows_of(folder / "out" / "scores.csv") for folder in (whole, broken)]
    assert [{k: v for k, v in row.items() if k != "seconds"} for row in tables[0]] == [
        {k: v for k, v in row.items() if k != "seconds"} for row in tables[1]
    ]
    for name in ("tiny-0", "tiny-1"):
        one, two = (load_file(folder / "out" / name / "fit" / "adapter_model.safetensors") for folder in (whole, broken))
        assert all(torch.allclose(one[key], two[key], atol=1e-6) for key in one)
