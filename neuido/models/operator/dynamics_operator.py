"""The neural intrinsic dynamics operator: branch heads and trunks, without the video encoder (paper, "Intrinsic Dynamics Operator").

A latent z in R^d represents a material. Two heads map it to coefficients lambda in R^D, two trunks map a deformation gradient to D basis
functions, and the law is their linear combination. As lambda is constant for a material, it is contracted with the last layer of the
trunk once, which is exact; a rollout then evaluates a small effective network (`neuido.physics.laws.neural.networks`).
"""

import hashlib
import json
from collections import Counter
from datetime import date
from pathlib import Path
from typing import Any, Literal, Self

import torch
from torch import Tensor, nn
from torch.nn import functional

from neuido.data.files.missing_weights import weights_hint
from neuido.data.weight_files import build, parse_metadata, read_safetensors, write_safetensors
from neuido.errors import UserError
from neuido.physics.laws.neural import readouts
from neuido.physics.laws.neural.bounded import BoundedElastic, FullPlastic
from neuido.physics.laws.neural.networks import ObjectiveElastic, ObjectivePlastic, RawElastic, RawPlastic

FORMAT = "neuido-operator/1"
WEIGHTS = Path(__file__).parents[1] / "weights"
PRETRAINED = {
    "pretrained": WEIGHTS / "stage1_bounded.safetensors",
    "pretrained-bounded": WEIGHTS / "stage1_bounded.safetensors",
    "pretrained-family": WEIGHTS / "stage1_family.safetensors",
    "pretrained-materials": WEIGHTS / "stage1_materials.safetensors",
    "pretrained-objective": WEIGHTS / "stage1.safetensors",
}
"""The operators that come with neuido. `pretrained`, also named `pretrained-bounded`, has the right sign of the stress at every
deformation; `pretrained-objective` is its predecessor. `pretrained-materials` knows eight families, fluids and snow among them, and has a
viscosity; no encoder reads it yet."""
ElasticNetwork = RawElastic | ObjectiveElastic
PlasticNetwork = RawPlastic | ObjectivePlastic
LAWS = {
    "raw": (RawElastic, RawPlastic),
    "objective": (ObjectiveElastic, ObjectivePlastic),
    "bounded": (BoundedElastic, ObjectivePlastic),
    "general": (BoundedElastic, FullPlastic),
}


class Trunk(nn.Module):
    """Three-layer MLP from nine features of F to D basis functions of n outputs each; the last layer is linear.

    Args:
        basis_dim: Number of basis functions D.
        hidden_dim: Width of the two hidden layers.
        outputs: Number of outputs n: nine components (raw), or the coefficients of the objective readouts.
    """

    def __init__(self, basis_dim: int, hidden_dim: int, outputs: int):
        super().__init__()
        self.basis_dim, self.outputs = basis_dim, outputs
        self.fc1 = nn.Linear(9, hidden_dim)
        self.fc2 = nn.Linear(hidden_dim, hidden_dim)
        self.out = nn.Linear(hidden_dim, basis_dim * outputs)

    def hidden(self, features: Tensor) -> Tensor:
        """Return the activations of the last hidden layer, (..., 9) -> (..., hidden_dim)."""
        return functional.silu(self.fc2(functional.silu(self.fc1(features))))

    def forward(self, features: Tensor) -> Tensor:
        """Evaluate the basis functions, (..., 9) -> (..., D, n)."""
        return self.out(self.hidden(features)).unflatten(-1, (self.basis_dim, self.outputs))

    def contract(self, coefficients: Tensor) -> tuple[Tensor, Tensor]:
        """Contract the last layer with the coefficients of S materials: lambda (S, D) -> W3 (S, n, hidden_dim), b3 (S, n)."""
        weight, bias = affine(self.out)
        weight = weight.reshape(self.basis_dim, -1)
        return (coefficients @ weight).view(-1, self.outputs, self.out.in_features), coefficients @ bias.view(self.basis_dim, -1)


VISCOSITY_UNIT = 1e-3
"""Viscosity at an output of zero of the viscosity head [Pa s]: that of water."""

NEGLIGIBLE = 1e-3
"""Viscosity up to which a rollout leaves it out [Pa s]: that of water, not felt by a body of a centimetre or more. As the head gives the
logarithm, its gradient is as small there."""

VISCOSITY_RANGE = (-20.0, 15.0)
"""Limits of the natural logarithm of the viscosity over its unit: 2e-12 to 3e3 Pa s."""


class Head(nn.Sequential):
    """Two-layer MLP from a latent z (S, d) to the coefficients lambda (S, D)."""

    def __init__(self, latent_dim: int, head_dim: int, basis_dim: int):
        super().__init__(nn.Linear(latent_dim, head_dim), nn.SiLU(), nn.Linear(head_dim, basis_dim))


def affine(layer: nn.Module) -> tuple[Tensor, Tensor]:
    """Return weight and bias of a linear layer; for a layer wrapped by an adapter they follow from its response to unit vectors."""
    if type(layer) is nn.Linear:
        return layer.weight, layer.bias
    like = next(layer.parameters())
    units = torch.eye(layer.in_features, dtype=like.dtype, device=like.device)
    rows = layer(torch.cat([torch.zeros_like(units[:1]), units]))
    return (rows[1:] - rows[0]).T, rows[0]


class IntrinsicDynamicsOperator(nn.Module):
    """Neural operator that maps a latent z to an elastic and a plastic law.

    Args:
        trunk: `raw` (as in the paper: from F to nine components), `objective` (from invariants to the coefficients of an isotropic,
            frame-indifferent law), `bounded` (the same with a stress that cannot have the wrong sign) or `general` (`bounded` with a
            plastic correction of any isotropic form, for fluids and snow).
        latent_dim: Latent dimension d (paper: 128).
        basis_dim: Number of basis functions D (the paper does not say).
        hidden_dim: Width of the trunks (the paper does not say; 64 suits a fused kernel).
        head_dim: Width of the heads.
        viscous: Give the laws a shear viscosity, from a third head.

    Attributes:
        latents: Latents of the training trajectories, (M, d); empty until `set_latents` or `load`.
        latent_names, latent_families: Their M names and families; the materials of NCLaw are `jelly`, `plasticine` and `sand`.
        card: Information on the training from the weights file.

    Raises:
        UserError: The trunk is unknown, or a size is below one.
    """

    def __init__(
        self,
        trunk: Literal["raw", "objective", "bounded", "general"] = "objective",
        latent_dim: int = 128,
        basis_dim: int = 64,
        hidden_dim: int = 64,
        head_dim: int = 128,
        viscous: bool = False,
    ):
        super().__init__()
        if trunk not in LAWS:
            raise UserError(f"trunk = {trunk!r}: choose raw, objective, bounded or general")
        self.config = {
            "trunk": trunk,
            "latent_dim": latent_dim,
            "basis_dim": basis_dim,
            "hidden_dim": hidden_dim,
            "head_dim": head_dim,
            **({"viscous": True} if viscous else {}),
        }
        for name, value in self.config.items():
            if name != "trunk" and value < 1:
                raise UserError(f"{name} = {value}: at least 1 is needed")
        self.trunk, self.latent_dim = trunk, latent_dim
        self._elastic_law, self._plastic_law = LAWS[trunk]
        self.elastic_trunk = Trunk(basis_dim, hidden_dim, self._elastic_law.outputs)
        self.plastic_trunk = Trunk(basis_dim, hidden_dim, self._plastic_law.outputs)
        self.elastic_head = Head(latent_dim, head_dim, basis_dim)
        self.plastic_head = Head(latent_dim, head_dim, basis_dim)
        self.viscosity_head = Head(latent_dim, head_dim, 1) if viscous else None
        self.set_latents(torch.zeros(0, latent_dim), [], [])
        self.card: dict[str, Any] = {}

    def __repr__(self) -> str:
        sizes = ", ".join(f"{name}={value!r}" for name, value in self.config.items())
        counts = Counter(self.latent_families)
        known = ", ".join(f"{count} {family}" for family, count in counts.items())
        return f"{type(self).__name__}({sizes}; {f'latents: {known}' if known else 'no latents'})"

    def set_latents(self, latents: Tensor, names: list[str], families: list[str]) -> None:
        """Store the latents of the training trajectories, for `save` and `latent`."""
        self.latents, self.latent_names, self.latent_families = latents.detach().clone(), list(names), list(families)

    def latent(self, name: str) -> Tensor:
        """Return the latent (d,) of a training trajectory.

        Raises:
            UserError: No trajectory has this name.
        """
        if name not in self.latent_names:
            raise UserError(f"no latent is named {name!r}; there are {', '.join(self.latent_names) or 'none'}")
        return self.latents[self.latent_names.index(name)].to(self.elastic_trunk.fc1.weight)

    def random_latents(self, count: int, generator: torch.Generator) -> Tensor:
        """Sample latents (count, d) from a normal distribution with the mean and componentwise standard deviation of the trained ones."""
        mean, deviation = self.latents.mean(0), self.latents.std(0)
        return mean + deviation * torch.randn(count, self.latent_dim, generator=generator).to(mean)

    def coefficients(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Return lambda^E and lambda^P, (S, D) each, of z (S, d)."""
        return self.elastic_head(z), self.plastic_head(z)

    def features(self, F: Tensor, law: type[ElasticNetwork] | type[PlasticNetwork]) -> Tensor:
        """Return the input features of the trunk of a law for F, (..., 3, 3) -> (..., 9)."""
        if self.trunk == "raw" or F.requires_grad:
            return law.features_of(F)
        return readouts.compute_strain_features(F.reshape(-1, 3, 3), law).view(*F.shape[:-2], 9)

    def basis(self, F: Tensor) -> tuple[Tensor, Tensor]:
        """Evaluate the elastic and the plastic basis functions at F (..., 3, 3), (..., D, n) each."""
        return self.elastic_trunk(self.features(F, self._elastic_law)), self.plastic_trunk(self.features(F, self._plastic_law))

    def elastic(self, z: Tensor, F: Tensor) -> Tensor:
        """Evaluate the Kirchhoff stress [Pa] (S, n, 3, 3) at deformation gradients F (S, n, 3, 3) for S latents z (S, d)."""
        law = self._elastic_law
        y = self._outputs(self.elastic_trunk, self.elastic_head(z), self.features(F, law))
        if self.trunk == "raw" or F.requires_grad:
            return law.stress_of(F, y, law.unit)
        return readouts.StressReadout.apply(y.flatten(0, 1), F.reshape(-1, 3, 3), law).view(F.shape)

    def plastic(self, z: Tensor, F: Tensor) -> Tensor:
        """Return the plastically corrected trial deformation gradients (S, n, 3, 3) for S latents z (S, d)."""
        law = self._plastic_law
        y = self._outputs(self.plastic_trunk, self.plastic_head(z), self.features(F, law))
        if self.trunk == "raw" or F.requires_grad:
            return law.corrected_of(F, y, law.unit)
        return readouts.CorrectionReadout.apply(y.flatten(0, 1), F.reshape(-1, 3, 3), law).view(F.shape)

    def _outputs(self, trunk: Trunk, coefficients: Tensor, features: Tensor) -> Tensor:
        weight, bias = trunk.contract(coefficients)
        return torch.baddbmm(bias.unsqueeze(1), trunk.hidden(features), weight.mT)

    def viscosity(self, z: Tensor) -> Tensor:
        """Return the shear viscosity [Pa s], (S,), of z (S, d) or (d,); zero without a viscosity head."""
        z = z.reshape(-1, self.latent_dim)
        if self.viscosity_head is None:
            return z.new_zeros(len(z))
        return VISCOSITY_UNIT * self.viscosity_head(z)[:, 0].clamp(*VISCOSITY_RANGE).exp()

    def laws(self, z: Tensor) -> tuple[ElasticNetwork, PlasticNetwork]:
        """Return the elastic and plastic law of z (S, d) or (d,) for a rollout of S scenes, differentiable in z and all weights.

        The elastic law has the viscosity of z, which every rollout adds to the effects; none if it is negligible.
        """
        z = z.reshape(-1, self.latent_dim)
        elastic, plastic = self.coefficients(z)
        law = self._elastic_law(*_effective(self.elastic_trunk, elastic))
        if self.viscosity_head is not None:
            viscosity = self.viscosity(z)
            if bool((viscosity > NEGLIGIBLE).any()):
                law.viscosity = viscosity
        return law, self._plastic_law(*_effective(self.plastic_trunk, plastic))

    def fingerprint(self) -> str:
        """Return the first twelve hexadecimal digits of the SHA-256 of the weights: what is trained on them fits no others."""
        digest = hashlib.sha256()
        for name, tensor in sorted(self.state_dict().items()):
            digest.update(name.encode() + tensor.detach().cpu().contiguous().numpy().tobytes())
        return digest.hexdigest()[:12]

    def save(self, path: str | Path, card: dict[str, Any] | None = None) -> None:
        """Write weights, latents and card to a safetensors file.

        Args:
            path: File to write; it is written atomically.
            card: Information on the training, such as data and metrics; the date is added.
        """
        tensors = {name: tensor.detach().contiguous().cpu() for name, tensor in self.state_dict().items()}
        tensors["latents"] = self.latents.detach().contiguous().cpu()
        metadata = {
            "format": FORMAT,
            "config": json.dumps(self.config),
            "latents": json.dumps({"names": self.latent_names, "families": self.latent_families}),
            "card": json.dumps({"date": date.today().isoformat(), **(card or {})}),
        }
        write_safetensors(path, tensors, metadata)

    @classmethod
    def from_pretrained(cls, name: str | Path = "pretrained") -> Self:
        """Load an operator that ships with neuido (`pretrained`, `pretrained-materials`, ...; see `load`), or a file of `save`.

        Raises:
            UserError: As in `load`.
        """
        return cls.load(name)

    @classmethod
    def load(cls, path: str | Path = "pretrained") -> Self:
        """Load a file of `save`, or an operator that ships with the package.

        The elastic law of `pretrained` has the right sign at every deformation. `pretrained-objective` is its predecessor, without that.
        `pretrained-family` was trained with a prior that pulls the latents of a family together, and `pretrained-materials` so over eight
        families, with a viscosity; no encoder reads either.

        Raises:
            UserError: The file is missing, or it is not an operator.
        """
        named = PRETRAINED.get(str(path))
        path = named or Path(path)
        if not path.is_file():
            config = "stage1_materials" if named == PRETRAINED["pretrained-materials"] else "stage1"
            remedy = f"make them: neuido fit --config configs/{config}.yaml, then `save_to`" if named else weights_hint(path)
            raise UserError(f"init_from: the weights {path} are missing: {remedy}")
        try:
            tensors, metadata = read_safetensors(path)
        except UserError as error:
            raise UserError(f"init_from: {error}") from error
        if metadata.get("format") != FORMAT:
            raise UserError(f"init_from: {path} has format {metadata.get('format')!r}, not {FORMAT!r}")
        config, latents, card = (parse_metadata(metadata, key, path) for key in ("config", "latents", "card"))
        points = tensors.pop("latents", None)
        operator = build(cls, config, tensors, path)
        names, families = latents.get("names"), latents.get("families")
        if points is None or not all(
            isinstance(given, list) and len(given) == len(points) and all(isinstance(name, str) for name in given)
            for given in (names, families)
        ):
            raise UserError(f"init_from: {path} must have a name and a family for each of its latents")
        if points.shape != (len(points), operator.latent_dim) or not bool(torch.isfinite(points).all()):
            raise UserError(f"init_from: {path}: latents must be finite and of the shape (M, {operator.latent_dim})")
        operator.set_latents(points, names, families)
        operator.card = card
        return operator


Operator = IntrinsicDynamicsOperator
"""The short public name."""


def _effective(trunk: Trunk, coefficients: Tensor) -> list[Tensor]:
    shared = [t[None] for layer in (trunk.fc1, trunk.fc2) for t in affine(layer)]
    return [*shared, *trunk.contract(coefficients)]
