"""The `latents` command: signature and help alone, so that `--help` loads no torch."""

import hashlib
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuido.data.files.output_folder import claimed_folder
from neuido.data.files.writing import check_writable, write_figure
from neuido.data.progress import Progress
from neuido.errors import UserError

if TYPE_CHECKING:
    from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
    from neuido.models.operator.interpolation import Interpolation

PARTS = ("space", "interpolation")
COLOURS = tuple(f"C{k}" for k in range(10))


def latents(
    *,
    operator: str = "pretrained",
    out: str = "runs/latents",
    parts: list[str] = ["space", "interpolation"],  # noqa: B006 (read only)
    ends: tuple[str, str] | None = None,
    family: str = "elastic",
    count: int = 9,
    perplexity: float = 10.0,
    seed: int = 0,
    device: str = "auto",
) -> None:
    """How the latents of Stage I lie, and what lies between two of them (paper, representation analysis).

    `space` writes silhouettes of the latents by family, as they are and in other labelled spaces (silhouettes.csv), their t-SNE
    (embedding.csv, embedding.png), and how few directions the laws feel (directions.csv). `interpolation` rolls out the laws between two
    latents in a drop test (interpolation.csv, .npz, .png) and says how steadily stiffness goes from one end to the other
    (monotonicity.csv), for these two and for all pairs of each family (pairs.csv). Needs scikit-learn for `space`.

    Args:
        operator: File of the operator (`save_to` of Stage I), `pretrained`, `pretrained-materials` or `pretrained-family`.
        out: Folder to write.
        parts: Which of the two.
        ends: Names of the two latents; the softest and the stiffest of `family` where absent.
        family: Whose.
        count: Laws from one end to the other.
        perplexity: Of t-SNE.
        seed: Of t-SNE.
        device: Device of the drop test: auto (CUDA where there is one), cpu or cuda.

    Raises:
        UserError: A part, a latent or a family that there is not; scikit-learn is not installed.
    """
    for part in parts:
        if part not in PARTS:
            raise UserError(f"parts: {part!r} is not known; choose from {', '.join(PARTS)}")
    from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator

    folder = Path(out)
    check_writable(folder)
    opened = IntrinsicDynamicsOperator.load(operator)
    plan = {"operator": _identity(operator), "ends": ends, "family": family, "count": count, "perplexity": perplexity, "seed": seed}
    held = claimed_folder(folder, plan, "the latents of other options", file="setup.json")
    with held, Progress("latents", len(parts), unit="parts") as work:
        if "space" in parts:
            work.say("silhouettes, t-SNE and directions")
            _space(opened, folder, perplexity, seed)
            work.update()
        if "interpolation" in parts:
            work.say("rollouts between two latents")
            _interpolation(opened, folder, ends, family, count, device)
    print(f"results in {folder}: tables (.csv), pictures (.png) and, of the interpolation, its motion (.npz)")


def _identity(operator: str) -> str:
    """Return what tells an operator from another: the digest of a file, or its name."""
    path = Path(operator).expanduser()
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else operator


def _space(operator: "IntrinsicDynamicsOperator", folder: Path, perplexity: float, seed: int) -> None:
    import numpy as np

    from neuido.data.files.score_tables import write_rows
    from neuido.models.operator.latent_space import active_directions, silhouettes, tsne

    points = tsne(operator, perplexity=perplexity, seed=seed)
    write_rows(folder / "embedding.csv", points)
    found = silhouettes(operator, np.array([(p["x"], p["y"]) for p in points]))
    write_rows(folder / "silhouettes.csv", found)
    for row in found:
        print(f"silhouette by family, {row['space']:22s}{row['silhouette']:7.3f}  ({row['meaning']})")
    write_rows(folder / "directions.csv", active_directions(operator))
    draw_embedding(points, folder / "embedding.png")


def _interpolation(
    operator: "IntrinsicDynamicsOperator", folder: Path, ends: tuple[str, str] | None, family: str, count: int, device: str
) -> None:
    import numpy as np

    from neuido.data.files.score_tables import write_rows
    from neuido.data.files.writing import write_arrays
    from neuido.models.operator.interpolation import interpolate, monotonicity, pairwise_monotonicity, softest_and_stiffest

    pairs = [{"family": each, **pairwise_monotonicity(operator, each)} for each in dict.fromkeys(operator.latent_families)]
    write_rows(folder / "pairs.csv", pairs)
    found = interpolate(operator, ends or softest_and_stiffest(operator, family), count=count, device=device)
    write_rows(folder / "interpolation.csv", found.rows)
    rows = [{"measure": name, **monotonicity([row[name] for row in found.rows])} for name in ("modulus", "compression", "contact")]
    write_rows(folder / "monotonicity.csv", rows)
    arrays = {"x": found.motion.numpy(), "shares": found.shares.numpy(), "names": np.array(found.names)}
    write_arrays(folder / "interpolation.npz", arrays)
    draw_interpolation(found, folder / "interpolation.png")
    print(f"from {found.names[0]} to {found.names[1]}:")
    for row in rows:
        steady = f"Spearman {row['spearman']:.3f}, {100 * row['steps']:.0f} % of the steps"
        print(f"{row['measure']:12s}{steady}, largest step back {row['back']:.3f}")


def draw_embedding(points: list[dict[str, Any]], path: Path) -> None:
    """Draw t-SNE by family; the darker, the stiffer within its family."""
    import math

    from matplotlib.colors import to_rgba
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.2, 4.2), layout="constrained")
    axes = figure.subplots()
    for colour, family in zip(cycle(COLOURS), dict.fromkeys(p["family"] for p in points)):
        own = [p for p in points if p["family"] == family]
        logs = [math.log(max(p["modulus"], 1.0)) for p in own]
        shades = [to_rgba(colour, 0.3 + 0.7 * (v - min(logs)) / (max(logs) - min(logs) or 1.0)) for v in logs]
        axes.scatter([p["x"] for p in own], [p["y"] for p in own], s=22, color=shades, linewidths=0, label=family)
    axes.set(xticks=[], yticks=[], title="t-SNE of the latents of Stage I (darker: stiffer)")
    axes.legend(frameon=False, fontsize=8)
    write_figure(path, figure, dpi=150)


def draw_interpolation(found: "Interpolation", path: Path) -> None:
    """Draw the body under each law at its greatest compression, and the measures over the share of the second latent."""
    from matplotlib.figure import Figure

    count = len(found.rows)
    figure = Figure(figsize=(1.5 * count, 4.2), layout="constrained")
    above, below = figure.subfigures(2, 1, squeeze=False, height_ratios=(1.0, 1.3))[:, 0]
    heights = found.motion[..., 1]
    when = (heights.amax(2) - heights.amin(2)).argmin(0).tolist()
    for i, (axes, frame) in enumerate(zip(above.subplots(1, count, squeeze=False)[0], when, strict=True)):
        x = found.motion[frame, i]
        axes.scatter(x[:, 0], x[:, 1], s=2, color="C0", linewidths=0)
        axes.set(xlim=(0.3, 0.7), ylim=(0.1, 0.45), aspect="equal", xticks=[], yticks=[])
        axes.set_title(f"{found.rows[i]['share']:.2f}", fontsize=8)
    labels = {"modulus": "small-strain modulus [Pa]", "compression": "greatest compression", "contact": "contact time [s]"}
    for axes, (name, label) in zip(below.subplots(1, 3), labels.items(), strict=True):
        axes.plot([row["share"] for row in found.rows], [row[name] for row in found.rows], ".-")
        axes.set_xlabel(f"share of {found.names[1]}", fontsize=8)
        axes.set_title(label, fontsize=8)
        axes.tick_params(labelsize=7)
    write_figure(path, figure, dpi=150)
