"""LPIPS: its properties with a made backbone, and absence with a reason where there is none."""

import pytest
import torch
from torch import nn

from neuido.errors import UserError
from neuido.models.scoring.lpips import LPIPS, Absent, open_lpips


def backbone(path, net="alex"):
    """A file in torchvision's layout with random weights."""
    torch.manual_seed(0)
    layers = [layer for group in LPIPS(net).groups for layer in group]
    weights = {}
    for number, layer in enumerate(layers):
        if isinstance(layer, nn.Conv2d):
            weights[f"features.{number}.weight"], weights[f"features.{number}.bias"] = layer.weight.data, layer.bias.data
    weights["classifier.1.weight"] = torch.zeros(2, 2)
    torch.save(weights, path)
    return weights


def test_properties(tmp_path):
    weights = backbone(tmp_path / "alex.pth")
    measure = open_lpips(str(tmp_path / "alex.pth"), "alex", "cpu")
    assert torch.equal(measure.groups[0][0].weight, weights["features.0.weight"])
    torch.manual_seed(1)
    image = torch.rand(2, 3, 64, 64)
    noise = torch.randn_like(image)
    distance = [measure(image, (image + s * noise).clamp(0, 1)) for s in (0.0, 0.02, 0.1)]
    assert (distance[0] == 0).all() and (distance[1] > 0).all() and (distance[2] > distance[1]).all()
    assert torch.allclose(measure(image, noise.clamp(0, 1)), measure(noise.clamp(0, 1), image))


def test_heads_are_those_of_torchmetrics():
    heads = LPIPS("vgg").heads
    assert [head.in_channels for head in heads] == [64, 128, 256, 512, 512]
    assert all((head.weight >= 0).all() and head.weight.sum() > 0.1 for head in heads)  # trained so, and not random


def test_absent_with_a_reason(tmp_path, monkeypatch):
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    absent = open_lpips(None, "vgg")
    assert isinstance(absent, Absent) and "vgg16-397923af.pth" in absent.reason
    with pytest.raises(UserError, match="no such file"):
        open_lpips(str(tmp_path / "none.pth"))
    backbone(tmp_path / "alex.pth")
    with pytest.raises(UserError, match="13"):
        open_lpips(str(tmp_path / "alex.pth"), "vgg")
