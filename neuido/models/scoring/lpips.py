"""LPIPS without torchvision (Zhang et al. 2018): feature layers of VGG16 or AlexNet, with the linear heads that torchmetrics ships.

The backbone is read from a local file: `vgg16-397923af.pth` or `alexnet-owt-7be5be79.pth` of torchvision, or the same tensors as
safetensors. Without one LPIPS is not computed, and `open_lpips` returns the reason.
"""

import os
import re
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from neuido.data.files.parsing import one_line
from neuido.errors import UserError
from neuido.physics.runtime.device import as_device

# output channels of the convolutions, "M" for max pooling; a feature is taken after each group
STACKS = {
    "vgg": ((64, 64), ("M", 128, 128), ("M", 256, 256, 256), ("M", 512, 512, 512), ("M", 512, 512, 512)),
    "alex": ((64,), ("M", 192), ("M", 384), (256,), (256,)),
}
FIRST = {64: (11, 4, 2), 192: (5, 1, 2)}  # kernel, stride and padding of AlexNet's first convolutions, by output channels
FILES = {"vgg": "vgg16-397923af.pth", "alex": "alexnet-owt-7be5be79.pth"}


class Absent(NamedTuple):
    """Placeholder for a metric that is not available, with the reason."""

    reason: str


class LPIPS(nn.Module):
    """Learned perceptual image patch similarity.

    Args:
        net: `vgg` (as in most publications) or `alex`.

    Attributes:
        channels: Channels of the five features.
    """

    def __init__(self, net: str = "vgg"):
        super().__init__()
        if net not in STACKS:
            raise UserError(f"lpips_net = {net!r}; one of {', '.join(STACKS)}")
        self.net, self.channels = net, [next(c for c in reversed(group) if c != "M") for group in STACKS[net]]
        groups, inputs = [], 3
        for group in STACKS[net]:
            layers: list[nn.Module] = []
            for out in group:
                if out == "M":
                    layers.append(nn.MaxPool2d(2, 2) if net == "vgg" else nn.MaxPool2d(3, 2))
                    continue
                kernel, stride, padding = FIRST.get(out, (3, 1, 1)) if net == "alex" else (3, 1, 1)
                layers += [nn.Conv2d(inputs, out, kernel, stride, padding), nn.ReLU()]
                inputs = out
            groups.append(nn.Sequential(*layers))
        self.groups = nn.ModuleList(groups)
        self.heads = nn.ModuleList([nn.Conv2d(c, 1, 1, bias=False) for c in self.channels])
        self.shift: Tensor
        self.spread: Tensor
        self.register_buffer("shift", torch.tensor([-0.030, -0.088, -0.188]).view(1, 3, 1, 1))
        self.register_buffer("spread", torch.tensor([0.458, 0.448, 0.450]).view(1, 3, 1, 1))
        self._load_heads()
        self.eval().requires_grad_(False)

    def _load_heads(self) -> None:
        import torchmetrics.functional.image

        path = Path(torchmetrics.functional.image.__file__).parent / "lpips_models" / f"{self.net}.pth"
        if not path.is_file():
            raise UserError(f"torchmetrics lacks {path.name}: LPIPS needs its linear heads, which torchmetrics 1.0 or later ships")
        weights = torch.load(path, map_location="cpu", weights_only=True)
        for i, head in enumerate(self.heads):
            head.weight.data.copy_(weights[f"lin{i}.model.1.weight"])

    def load_backbone(self, path: str | os.PathLike) -> None:
        """Load the convolutions from a torchvision file (`features.N.weight`).

        Raises:
            UserError: The file cannot be read or lacks these tensors.
        """
        try:
            if str(path).endswith(".safetensors"):
                from safetensors.torch import load_file

                weights = load_file(path)
            else:
                weights = torch.load(path, map_location="cpu", weights_only=True)
        except Exception as error:  # torch and safetensors name no one type for a file that is malformed or not safe
            raise UserError(f"lpips_backbone = {path} cannot be read: {one_line(error)}") from error
        if not isinstance(weights, dict) or not all(isinstance(name, str) and isinstance(t, Tensor) for name, t in weights.items()):
            raise UserError(f"lpips_backbone = {path} holds no tensors by name")
        convolutions = [layer for group in self.groups for layer in group.children() if isinstance(layer, nn.Conv2d)]
        names = sorted({int(found[1]) for name in weights if (found := re.match(r"features\.([0-9]{1,4})\.", name))})
        if len(names) != len(convolutions):
            raise UserError(f"lpips_backbone = {path} has {len(names)} layers of features; {self.net} has {len(convolutions)}")
        for number, layer in zip(names, convolutions):
            for part in ("weight", "bias"):
                own, given = getattr(layer, part), weights.get(f"features.{number}.{part}")
                if given is None or own.shape != given.shape:
                    found = "missing" if given is None else tuple(given.shape)
                    raise UserError(f"lpips_backbone = {path}: features.{number}.{part} is {found}, not {tuple(own.shape)}")
                own.data.copy_(given)

    def forward(self, a: Tensor, b: Tensor) -> Tensor:
        """Return the distance of each pair of images (B, 3, H, W) in [0, 1], (B,)."""
        total = a.new_zeros(len(a))
        x, y = (((2 * image - 1) - self.shift) / self.spread for image in (a, b))
        for group, head in zip(self.groups, self.heads):
            x, y = group(x), group(y)
            difference = (functional.normalize(x, dim=1, eps=1e-10) - functional.normalize(y, dim=1, eps=1e-10)).square()
            total = total + head(difference).mean((1, 2, 3))
        return total


def open_lpips(backbone: str | None = None, net: str = "vgg", device: str | torch.device = "auto") -> LPIPS | Absent:
    """Open LPIPS with the weights of a local file.

    Args:
        backbone: File of the weights; where absent, the file of torchvision in the cache of torch.hub, if there is one.
        net: `vgg` or `alex`.
        device: `auto` (CUDA where available), `cpu`, `cuda`, or a torch device.

    Returns:
        The module, or the reason why it is not available.

    Raises:
        UserError: The given file does not exist or does not fit.
    """
    path = Path(backbone).expanduser() if backbone else Path(torch.hub.get_dir()) / "checkpoints" / FILES[net]
    if not path.is_file():
        if backbone:
            raise UserError(f"lpips_backbone = {backbone}: there is no such file")
        return Absent(f"no weights of the {net} backbone: give the file {FILES[net]} of torchvision as lpips_backbone")
    module = LPIPS(net)
    module.load_backbone(path)
    return module.to(as_device(device))
