"""The demonstration's first part: pre-train the operator on small simulated bodies, then let its laws move a body of another shape."""

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from neuido.data.files.writing import write_figure

if TYPE_CHECKING:
    import numpy as np

    from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator

STEPS, EVERY, DT = 600, 200, 5e-4
CELLS, INSET = 20, 2.0


class Comparison(NamedTuple):
    """A ball under the true and under the learned law of one material."""

    name: str
    true: "np.ndarray"
    """Positions [m] at the frames, (K, P, 3)."""
    learned: "np.ndarray"
    """The same, under the learned law."""

    @property
    def rmse(self) -> float:
        """Root mean square distance of matched particles over all frames [m]."""
        return float(((self.learned - self.true) ** 2).sum(-1).mean() ** 0.5)

    @property
    def path(self) -> float:
        """Root mean square displacement from the start under the true law, over the same frames [m]."""
        return float(((self.true - self.true[:1]) ** 2).sum(-1).mean() ** 0.5)


class LawsResult(NamedTuple):
    """Result of the demonstration of learned laws: true and learned motion and their errors."""

    rows: tuple[tuple[str, float, float, float, float], ...]
    """Material; relative errors of stress and of the plastic correction; particle RMSE [m], and that over the path."""
    picture: Path
    """The ball under the true and the learned laws."""


def demo_laws(out: str = "runs/demo", *, settings: str = "quickstart") -> LawsResult:
    """Pre-train the operator on small simulated bodies, and compare the motion under its laws with that under the true ones.

    Runs `neuido fit --config quickstart` on trajectories of a thrown cube, then drops a ball that the operator has not seen,
    prints a table and draws a picture. Takes about a minute on one CPU core; a second run reuses the trajectories.

    Args:
        out: Folder for the trajectories, the run and the picture.
        settings: Configuration to train with.
    """
    from neuido.commands.cli.config_files import find_config
    from neuido.commands.cli.trainer import run_lightning

    folder, config = Path(out), find_config(settings, "--settings")
    print(f"[laws 1/2] neuido fit --config {settings} --data.root {folder / 'trajectories'}", flush=True)
    root = ["--data.root", str(folder / "trajectories"), "--trainer.default_root_dir", str(folder)]
    trained = run_lightning(["fit", "--config", config, *root])
    print("[laws 2/2] a falling ball under the true and under the learned laws", flush=True)
    data = trained.datamodule
    chosen: dict[str, tuple[str, dict[str, float]]] = {}
    for name, family, values in zip(data.names, data.families, data.parameters, strict=True):
        chosen.setdefault(family, (name, values))  # the first of each family: NCLaw's published material
    compared = [_compare(trained.model.operator, name, family, values) for family, (name, values) in chosen.items()]
    figures = {key: float(value) for key, value in trained.trainer.callback_metrics.items()}
    stress, plastic = ([figures.get(f"val/{kind}_error/{family}", float("nan")) for family in chosen] for kind in ("stress", "plastic"))
    rows = tuple(
        (each.name, of_stress, of_flow, each.rmse, each.rmse / each.path)
        for each, of_stress, of_flow in zip(compared, stress, plastic, strict=True)
    )
    _print_table(rows)
    picture = folder / "demo.png"
    _draw(compared, picture)
    print(f"picture: {picture}\nrun: {trained.trainer.log_dir}")
    return LawsResult(rows, picture)


def _compare(operator: "IntrinsicDynamicsOperator", name: str, family: str, parameters: dict[str, float]) -> Comparison:
    import torch

    from neuido.data.bodies.families import laws
    from neuido.data.bodies.shapes import ball
    from neuido.physics.mpm.simulator import Simulator
    from neuido.types import Scene, Walls

    body = ball(centre=(0.5, 0.3, 0.5), radius=0.15, spacing=0.027, velocity=(0.5, -1.0, 0.0))
    simulator = Simulator(Scene(cells=CELLS, dt=DT, walls=Walls(inset=INSET)), body, device="cpu")
    with torch.no_grad():
        true = simulator.rollout(STEPS, *laws(family, [parameters]), every=EVERY).x
        learned = simulator.rollout(STEPS, *operator.cpu().laws(operator.latent(name)), every=EVERY).x
    return Comparison(name, true.numpy(), learned.numpy())


def _print_table(rows: tuple[tuple[str, float, float, float, float], ...]) -> None:
    print(f"\n{'material':<14}{'stress error':>14}{'plastic error':>15}{'particle RMSE':>16}{'of the path':>14}")
    for name, stress, plastic, rmse, share in rows:
        print(f"{name:<14}{stress:>14.2e}{plastic:>15.2e}{rmse:>14.2e} m{share:>14.2e}")
    print("Errors: relative, medians over held-out particles and steps of the family (a material that does not flow has none).")
    print(f"RMSE: matched particles of a falling ball of 0.3 m, against the true law, over {STEPS * DT:g} s.\n")


def _draw(compared: list[Comparison], path: Path) -> None:
    from matplotlib.figure import Figure

    times = [DT * EVERY * k for k in range(len(compared[0].true))]
    figure = Figure(figsize=(2.8 * len(times), 1.8 * len(compared)), layout="constrained")
    figure.suptitle("A falling ball, a shape that training has not seen: all particles, from the front", fontsize=9)
    panels = figure.subplots(len(compared), len(times), squeeze=False, sharex=True, sharey=True)
    for row, each in zip(panels, compared, strict=True):
        row[0].set_ylabel(f"{each.name}\ny [m]", fontsize=9)
        for panel, true, learned in zip(row, each.true, each.learned, strict=True):
            panel.axhline(INSET / CELLS, color="0.4", linewidth=0.8)  # the floor
            panel.scatter(true[:, 0], true[:, 1], s=14, facecolors="none", edgecolors="0.6", linewidths=0.5, label="true law")
            panel.scatter(learned[:, 0], learned[:, 1], s=3, color="tab:red", linewidths=0, label="learned law")
            panel.set(xlim=(0.1, 0.9), ylim=(0.05, 0.5), aspect="equal")
            panel.tick_params(labelsize=6)
    for panel, time in zip(panels[0], times, strict=True):
        panel.set_title(f"t = {time:g} s", fontsize=9)
    for panel in panels[-1]:
        panel.set_xlabel("x [m]", fontsize=8)
    panels[0][0].legend(fontsize=6, loc="upper right")
    write_figure(path, figure, dpi=150)
