"""The trained networks of NCLaw (Ma et al. 2023), unchanged or adapted to images by LoRA (NeuMA, Cao et al. 2024)."""

import math
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn

from neuido.data.bodies.scene_files import data_root
from neuido.data.files.parsing import read_arrays
from neuido.errors import UserError
from neuido.models.fewshot.method import Method, require_positive
from neuido.models.inference.prepared_scene import Laws, PreparedScene
from neuido.physics.laws.neural.invariants import InvariantElastic, InvariantPlastic

LAYERS = (("layers.0", (64, 13)), ("layers.1", (64, 64)), ("final_layer", (9, 64)))
PARTS = ("elasticity", "plasticity")
MATERIALS = {"identity": "jelly", "von_mises": "plasticine", "drucker_prager": "sand"}
"""Material of NCLaw for each plasticity law; NeuMA makes the same choice for its six scenes."""


def load_nclaw(path: str | Path) -> tuple[InvariantElastic, InvariantPlastic]:
    """Read the trained laws of NCLaw (Ma et al. 2023, `InvariantFullMeta`; see `neuido.physics.laws.neural.invariants`).

    Args:
        path: npz file with `elasticity.*` and `plasticity.*`, each `layers.0`, `layers.1` and `final_layer`.

    Returns:
        Elastic and plastic law, for one scene or shared by all.

    Raises:
        UserError: The file is missing or holds other arrays.
    """
    elastic, plastic = read_nclaw_weights(path)
    return InvariantElastic(*(w[None] for w in elastic)), InvariantPlastic(*(w[None] for w in plastic))


def read_nclaw_weights(path: str | Path) -> tuple[list[Tensor], list[Tensor]]:
    """Read the three layers of the elastic and of the plastic network, (64, 13), (64, 64) and (9, 64) each.

    Raises:
        UserError: As `load_nclaw`.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"NCLaw's weights {path} are missing: give the path of an nclaw-*.npz file")
    arrays = read_arrays(path, None, what="file of NCLaw's weights")
    if wrong := [name for name, array in arrays.items() if array.dtype.kind != "f" or array.dtype.itemsize > 8]:
        raise UserError(f"{path}: the array {wrong[0]} holds {arrays[wrong[0]].dtype} and not floats of up to 64 bits")
    weights = {name: torch.from_numpy(array) for name, array in arrays.items()}
    return tuple([_layer(weights, f"{part}.{name}", shape, path) for name, shape in LAYERS] for part in PARTS)  # type: ignore[return-value]


def _layer(weights: dict[str, Tensor], name: str, shape: tuple[int, int], path: Path) -> Tensor:
    found = [w for key, w in weights.items() if key.startswith(name)]
    if len(found) != 1 or tuple(found[0].shape) != shape:
        raise UserError(f"{path}: no array {name} of shape {shape}; it has {', '.join(sorted(weights))}")
    return found[0]


class LoRAWeight(nn.Module):
    """Weight W + alpha / r B A with frozen W (m, n), A (r, n) initialised by Kaiming and B (m, r) by zero (NeuMA, `loralib`)."""

    weight: Tensor

    def __init__(self, weight: Tensor, rank: int, alpha: float, generator: torch.Generator):
        super().__init__()
        self.scale = alpha / rank
        self.register_buffer("weight", weight)
        self.A = nn.Parameter(torch.empty(rank, weight.shape[1]))
        self.B = nn.Parameter(torch.zeros(weight.shape[0], rank))
        nn.init.kaiming_uniform_(self.A, a=math.sqrt(5), generator=generator)

    def forward(self) -> Tensor:
        return self.weight + self.scale * self.B @ self.A


class NCLaw(Method):
    """Use the trained networks of NCLaw unchanged; no image is used (Ma et al. 2023).

    Args:
        weights: Folder with nclaw-{jelly,plasticine,sand}.npz, or one such file for every scene; `peers` in the data folder where absent.
        base: Material of the network; `auto` selects it by the plasticity of the declared model, as NeuMA does.

    Raises:
        UserError: `build` does not find the file.
    """

    steps = 0

    def __init__(self, weights: str | None = None, base: Literal["auto", "jelly", "plasticine", "sand"] = "auto"):
        super().__init__()
        self.source, self.base = weights, base

    def build(self, scene: PreparedScene) -> None:
        self.chosen = MATERIALS[scene.source.model["plasticity"]["law"]] if self.base == "auto" else self.base
        self._register_layers(*read_nclaw_weights(self._file()))

    def _file(self) -> Path:
        given = Path(self.source).expanduser() if self.source is not None else None
        if given is not None and not given.is_dir():
            return given
        if given is None:
            try:
                given = data_root() / "peers"
            except UserError as error:
                raise UserError("model.method.weights: give the folder of nclaw-*.npz, or set the variable NEUIDO_DATA") from error
        return given / f"nclaw-{self.chosen}.npz"

    def _register_layers(self, elastic: list[Tensor], plastic: list[Tensor]) -> None:
        for part, weights in zip(PARTS, (elastic, plastic)):
            for i, weight in enumerate(weights):
                self.register_buffer(f"{part}_{i}", weight)

    def _layers(self, part: str) -> list[Tensor]:
        return [getattr(self, f"{part}_{i}")[None] for i in range(len(LAYERS))]

    def laws(self, scene: PreparedScene) -> Laws:
        return InvariantElastic(*self._layers("elasticity")), InvariantPlastic(*self._layers("plasticity"))

    def describe(self) -> dict[str, Any]:
        return {"base": self.chosen, "modulus": float(InvariantElastic(*self._layers("elasticity")).modulus()[0])}


class NeuMA(NCLaw):
    """Adapt NCLaw's networks by LoRA on every layer, with RAdam over a thousand steps (Cao et al. 2024, configs/synthetic).

    Args:
        weights, base: As for `NCLaw`.
        rank, alpha: LoRA rank and alpha.
        elastic_rate, plastic_rate: Learning rates; where absent those of NeuMA for the base: 0.008, 0.02 or 0.005, and a tenth of it.
        seed: Seed of the LoRA factors A.

    Raises:
        UserError: The rank is below one, or alpha or a rate is not positive.
    """

    RATES = {"jelly": (0.008, 0.025), "plasticine": (0.02, 0.01), "sand": (0.005, 0.04)}
    """Elastic learning rate, and the fraction of the rates at which their cosine schedule ends."""

    steps = 1000

    def __init__(
        self,
        weights: str | None = None,
        base: Literal["auto", "jelly", "plasticine", "sand"] = "auto",
        rank: int = 16,
        alpha: float = 16.0,
        elastic_rate: float | None = None,
        plastic_rate: float | None = None,
        seed: int = 0,
    ):
        super().__init__(weights, base)
        if rank < 1:
            raise UserError(f"model.method.rank = {rank}: at least 1 is needed")
        given = {"elastic_rate": elastic_rate, "plastic_rate": plastic_rate}
        require_positive(alpha=alpha, **{name: value for name, value in given.items() if value is not None})
        self.rank, self.alpha, self.given, self.seed = rank, alpha, (elastic_rate, plastic_rate), seed

    def _register_layers(self, elastic: list[Tensor], plastic: list[Tensor]) -> None:
        generator = torch.Generator().manual_seed(self.seed)
        parts = zip(PARTS, (elastic, plastic))
        lora = {part: nn.ModuleList(LoRAWeight(w, self.rank, self.alpha, generator) for w in weights) for part, weights in parts}
        self.lora = nn.ModuleDict(lora)

    def _layers(self, part: str) -> list[Tensor]:
        return [layer()[None] for layer in self.lora[part].children()]

    def parameter_groups(self) -> list[dict[str, Any]]:
        usual = self.RATES[self.chosen][0]
        rates = (self.given[0] or usual, self.given[1] or 0.1 * usual)
        return [{"params": list(self.lora[part].parameters()), "lr": rate} for part, rate in zip(PARTS, rates)]

    def optimizer(self, groups: list[dict[str, Any]]) -> torch.optim.Optimizer:
        return torch.optim.RAdam(groups)

    def rate(self, done: float) -> float:
        last = self.RATES[self.chosen][1]
        return last + (1 - last) * super().rate(done)
