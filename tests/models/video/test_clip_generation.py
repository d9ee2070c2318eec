"""Clips for the encoder: what is in them, that they are the same again, that they resume; and that training on them learns."""

import json
import os
import re
import shutil

import numpy as np
import pytest
import torch
from lightning.pytorch import Trainer, seed_everything

from neuido.commands.film import film
from neuido.data.bodies.families import laws
from neuido.data.clips import FilmDataModule, read_clip
from neuido.errors import UserError
from neuido.models.stages.pretrain_vae import FlowVAEModule
from neuido.models.stages.warmup import WarmupModule, compare_laws
from neuido.models.video import clip_generation
from neuido.models.video.clip_bodies import SOLIDS
from neuido.models.video.encoder import DynamicsEncoder
from neuido.models.video.flow_vae import FlowVAE
from neuido.physics.runtime.events import CRUSHED, INVERTED, Event
from neuido.physics.runtime.frames import Frames

TINY = {"count": 9, "views": 2, "frames": 9, "frame_steps": 8, "dts": [2e-3, 1e-3], "cells": 12, "particles": 150, "width": 48,
        "flow_size": 32, "samples": 32, "device": "cpu", "progress": False}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("films")
    film(str(path), **TINY)
    return path


def trainer(tmp_path, **options):
    options = {"logger": False, "enable_checkpointing": False, "num_sanity_val_steps": 0, **options}
    return Trainer(accelerator="cpu", default_root_dir=tmp_path, enable_progress_bar=False, enable_model_summary=False, **options)


def test_clips(folder):
    data = FilmDataModule(str(folder), frames=8)
    assert [clip["family"] for clip in data.clips] == ["elastic", "plasticine", "sand"] * 3
    clip = data.read(1)
    assert clip.flow.shape == (2, 8, 32, 32, 2)
    assert 0.3 < clip.flow.float().norm(dim=-1).max() < 10  # m/s
    assert 2e-3 < clip.cell[0] < 0.05
    assert clip.frame_interval in (pytest.approx(8e-3), pytest.approx(16e-3))
    elastic, plastic = laws("plasticine", [data.clips[1]["parameters"]])
    assert torch.allclose(plastic(clip.trial.double()).float(), clip.corrected, atol=1e-5)
    assert torch.allclose(elastic(clip.corrected.double()).float(), clip.stress, rtol=1e-3, atol=1.0)
    window = next(iter(data.train_dataloader()))
    assert window.flow.shape == (16, 8, 32, 32, 2)


def test_what_makes_a_clip_doubtful_is_printed(tmp_path, monkeypatch, capsys):
    found = (Event(CRUSHED, 1, 2, 150, 1000, 3, 0.006, 1, 5e-4), Event(INVERTED, 0, 1, 150, 4, 3, 0.006, 1, -0.2))
    monkeypatch.setattr(Frames, "events", found)
    film(str(tmp_path / "a"), **{**TINY, "count": 6}, batch=2)
    noted = [line for line in capsys.readouterr().out.splitlines() if line.startswith("note: ")]
    first, second = zip(*sorted(zip(noted[1::2], noted[::2])))  # of each pair that was simulated at once, in whatever order
    assert list(first) == [f"note: clip-0000{k}: {found[1].words}" for k in range(3)]
    own = [int(re.search(r"particle (\d+)", line)[1]) for line in second]  # counted from the clip's first
    assert list(second) == [f"note: clip-0000{k + 3}: {found[0]._replace(first=own[k]).words}" for k in range(3)]
    assert all(TINY["particles"] / 2 < 1000 - first < 2 * TINY["particles"] for first in own)


def test_shards_make_the_same_clips(folder, tmp_path):
    for shard in (1, 0):
        assert not (tmp_path / "a" / "index.json").exists()
        film(str(tmp_path / "a"), **{**TINY, "count": 3}, shard=shard, shards=2)
    for number in range(3):
        with np.load(folder / f"clip-{number:05d}.npz") as whole, np.load(tmp_path / "a" / f"clip-{number:05d}.npz") as part:
            assert np.array_equal(whole["flow"], part["flow"])
    assert len(json.loads((tmp_path / "a" / "index.json").read_text())["clips"]) == 3
    with pytest.raises(UserError, match="shard = 2"):
        film(str(tmp_path / "a"), **{**TINY, "count": 3}, shard=2, shards=2)


def test_the_index_needs_no_body_and_finds_a_damaged_clip(folder, tmp_path, monkeypatch):
    """The last shard compares the clips of the others; the index of 3,600 clips took minutes when their bodies were made again."""
    copy = tmp_path / "a"
    shutil.copytree(folder, copy)
    index = (copy / "index.json").read_text()
    (copy / "index.json").unlink()
    monkeypatch.setattr(clip_generation, "random_body", None)
    film(str(copy), **TINY, shard=1, shards=3)
    assert (copy / "index.json").read_text() == index
    (copy / "index.json").unlink()
    with (copy / "clip-00002.npz").open("r+b") as file:
        file.seek(200)
        file.write(b"damaged")
    film(str(copy), **TINY, shard=1, shards=3)
    assert not (copy / "index.json").exists()


def test_a_body_falls(folder):
    flow = read_clip(folder / "clip-00000.npz").flow.float()
    moving = flow[:, 0][flow[:, 0].norm(dim=-1) > 0.2]
    assert len(moving) > 20 and (moving[:, 1] > 0).float().mean() > 0.9  # y points down in an image


def test_it_resumes_and_repeats(folder, tmp_path, monkeypatch):
    film(str(tmp_path / "a"), **{**TINY, "count": 2})
    first = (tmp_path / "a" / "clip-00001.npz").stat()
    os.remove(tmp_path / "a" / "clip-00000.npz")
    (tmp_path / "a" / "index.json").unlink()
    film(str(tmp_path / "a"), **{**TINY, "count": 2})
    assert (tmp_path / "a" / "clip-00001.npz").stat().st_mtime_ns == first.st_mtime_ns
    for name in ("flow", "stress"):
        with np.load(folder / "clip-00000.npz") as old, np.load(tmp_path / "a" / "clip-00000.npz") as new:
            assert np.array_equal(old[name], new[name])
    assert len(json.loads((tmp_path / "a" / "index.json").read_text())["clips"]) == 2
    with pytest.raises(UserError, match="count is 2 there and 3 here"):
        film(str(tmp_path / "a"), **{**TINY, "count": 3})
    with pytest.raises(UserError, match="neuido film"):
        _ = FilmDataModule(str(tmp_path / "b")).index


@pytest.mark.slow
def test_vae_training_learns(folder, tmp_path):
    seed_everything(0)
    data = FilmDataModule(str(folder), batch_size=4, frames=8, windows=2, held_out=0.2)
    module = FlowVAEModule(8, lr=3e-3, save_to=str(tmp_path / "vae.safetensors"))
    before = trainer(tmp_path).validate(module, data, verbose=False)[0]
    trainer(tmp_path, max_steps=40, check_val_every_n_epoch=10).fit(module, data)
    after = trainer(tmp_path).validate(module, data, verbose=False)[0]
    assert after["val/error"] < 0.8 * before["val/error"]
    vae = FlowVAE.load(tmp_path / "vae.safetensors")
    assert vae.card["steps"] in (10, 20, 30, 40) and vae.scale != 1  # of the best validation
    assert vae.card["figures"]["val/error"] == pytest.approx(after["val/error"], rel=1e-4)


@pytest.mark.slow
def test_warm_up_learns_and_touches_the_projector_alone(folder, tmp_path):
    seed_everything(0)
    torch.manual_seed(0)
    # the trained VAE: latents of an untrained one hardly differ between clips (0.007 against 0.3), and all of these have one frame rate
    options = {"vae": "pretrained", "flow_size": 32, "width": 48, "dropout": 0.0, "lr": 3e-3, "noise": 0.0}
    module = WarmupModule(**options, reader_width=48, save_to=str(tmp_path / "encoder.safetensors"))
    frozen = {name: p.clone() for name, p in module.named_parameters() if "projector" not in name}
    data = FilmDataModule(str(folder), batch_size=6, frames=0, held_out=0.2)
    fit = trainer(tmp_path, max_steps=100, check_val_every_n_epoch=100)
    losses, log = [], module.log_dict

    def record(values, **options):
        if "train/stress" in values:  # of the law, without the reader's
            losses.append(values["train/stress"] + values["train/plastic"] + 0.3 * values["train/size"])
        log(values, **options)

    module.log_dict = record
    fit.fit(module, data)
    assert torch.stack(losses[-10:]).mean() < 0.6 * losses[0]
    assert frozen and all(torch.equal(p, dict(module.named_parameters())[name]) for name, p in frozen.items())
    encoder = DynamicsEncoder.load(tmp_path / "encoder.safetensors")
    assert encoder.card["stage"] == "warm-up" and encoder.card["figures"]["val/family"] <= 1
    assert encoder.reader.families == ("elastic", "plasticine", "sand") and encoder.reader.limit < 100  # calibrated
    assert encoder.reader.known.tolist() == [[1, 1, 0, 0, 0], [1, 1, 1, 0, 0], [1, 1, 0, 1, 0]]


def test_judgement_is_the_same_for_twice_and_half():
    class Fake:
        def __init__(self, factor, stress):
            self.factor, self.stress = factor, stress

        def elastic(self, z, F):
            return self.factor * self.stress

        def plastic(self, z, F):
            return F

    F = torch.eye(3) + 0.1 * torch.randn(1, 16, 3, 3)
    stress = 1e6 * torch.randn(1, 16, 3, 3)
    twice, half, same = (compare_laws(Fake(factor, stress), torch.zeros(1, 2), F, F, stress) for factor in (2.0, 0.5, 1.0))
    assert twice.size.item() == pytest.approx(np.log(2), rel=1e-3) == half.size.item()
    assert twice.stress.item() == pytest.approx(1 / 3, rel=0.02) and half.stress.item() == pytest.approx(1 / 3, rel=0.02)
    assert same.stress == 0 and same.plastic == 0 and same.size < 1e-5


def test_rates_shapes_and_a_clip_that_is_left_out(tmp_path, monkeypatch):
    options = {**TINY, "count": 6, "rates": [60.0, 240.0], "held_out": 0.34, "samples": 8}
    own = clip_generation.simulate_clips
    monkeypatch.setattr(clip_generation, "simulate_clips", lambda group, *rest: [
        None if clip.name == "clip-00001" else motion for clip, motion in zip(group, own(group, *rest))])  # fmt: skip
    film(str(tmp_path), **options)
    clips = json.loads((tmp_path / "index.json").read_text())["clips"]
    assert [clip["name"] for clip in clips] == [f"clip-0000{k}" for k in (0, 2, 3, 4, 5)]
    assert "left_out" in json.loads((tmp_path / "clip-00001.json").read_text())
    assert all((clip["shape"] in SOLIDS["held-out"]) == (clip["name"] >= "clip-00004") for clip in clips)
    assert all(60 <= 1 / read_clip(tmp_path / f"{clip['name']}.npz").frame_interval <= 240 for clip in clips)
    with pytest.raises(UserError, match=r"rates = \[240.0, 60.0\]"):
        film(str(tmp_path / "b"), **{**options, "rates": [240.0, 60.0]})
