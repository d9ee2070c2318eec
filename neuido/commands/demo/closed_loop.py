"""The demonstration's last part: a small experiment whose model lacks an effect, diagnosed by the command's own code."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from neuido.data.files.writing import write_figure
from neuido.errors import UserError

if TYPE_CHECKING:
    from neuido.data.measured.experiment import Experiment
    from neuido.types import Scene

UNDECLARED = {"drag_linear.k": 3.0}
"""What the demonstration's body feels and its model does not say [1/s]."""
TRUE_YOUNG, DECLARED_YOUNG = 6e4, 8e4
ELASTIC: dict[str, Any] = {
    "density": 1000.0,
    "elasticity": {"law": "fixed_corotated", "young": TRUE_YOUNG, "poisson": 0.3},
    "plasticity": {"law": "identity"},
}
DRAWS = 99
BEFORE, AFTER = "tab:red", "tab:blue"


class Launch(NamedTuple):
    """How the block starts."""

    name: str
    role: str
    """`fit` or `held_out`."""
    velocity: tuple[float, float, float]
    """[m/s]"""
    spin: float = 0.0
    """About z [rad/s]."""
    stretch: float = 0.0
    """Rate along x, shortening y [1/s]: the block rings."""
    centre: tuple[float, float, float] = (0.5, 0.5, 0.5)
    """[m]"""


LAUNCHES = (
    Launch("throw", "fit", (1.2, 1.0, 0.3), spin=5.0, stretch=3.0, centre=(0.35, 0.5, 0.5)),
    Launch("toss", "held_out", (-2.4, 2.0, -0.8), spin=-4.0, stretch=-3.0, centre=(0.68, 0.42, 0.5)),
)


class LoopResult(NamedTuple):
    """What one closed loop found."""

    answer: str
    """effect, class, none, unknown or insufficient."""
    effects: tuple[tuple[str, ...], ...]
    """The class of each effect that was added, the chosen one first."""
    before: float
    """Held-out error of the declared model, refitted [m]."""
    after: float
    """The same with the effects added."""
    floor: float
    """Noise and discretisation [m]."""
    seconds: float
    parameters: dict[str, float]
    """Of the effects, by flat names."""
    truth: dict[str, float]
    """What acts and is not declared, by flat names."""
    again: str
    """The answer of a second pass on the model that came out; empty where there was none."""
    picture: Path
    """Residual, ranking and errors."""
    report: Path
    """The diagnosis' own page."""

    @property
    def words(self) -> str:
        """The answer with its effects."""
        from neuido.discrepancy.report.wording import named

        names = " and ".join(" or ".join(map(named, names)) for names in self.effects)
        return f"{self.answer}: {names}" if names else self.answer


def demo_loop(
    out: str = "runs/demo/loop", *, effects: str | None = None, draws: int = DRAWS, second_pass: bool = True, progress: bool = True
) -> LoopResult:
    """Simulate two throws of a block with air drag, and diagnose a model of the block that has none.

    Runs `neuido diagnose` on the simulated recordings, prints its answer beside the truth, and draws the result. With `second_pass` it
    diagnoses the resulting model too, which should lack nothing.

    Args:
        out: Folder for the experiment, the diagnosis and the picture.
        effects: Names of the effects to consider, separated by commas. None: all that can act on such a body.
        draws: Draws of the parametric bootstrap.
        second_pass: Whether to diagnose the resulting model too.
        progress: Whether to show progress.

    Returns:
        The answer, the errors before and after [m], the truth, and the paths of picture and report.
    """
    from neuido.commands.diagnose import diagnose

    folder = Path(out)
    print("[loop 1/2] two throws of a block, with an effect that the model does not declare", flush=True)
    record(folder / "experiment", UNDECLARED)
    print(f"[loop 2/2] neuido diagnose {folder / 'experiment'} --out {folder / 'diagnosis'}", flush=True)
    options: dict[str, Any] = {"effects": effects, "draws": draws, "device": "cpu", "progress": progress}
    diagnose(str(folder / "experiment"), out=str(folder / "diagnosis"), **options)
    content = json.loads((folder / "diagnosis" / "diagnosis.json").read_text())
    again = ""
    if second_pass:
        print("the same once more, with the model that came out: ", end="", flush=True)
        model = str(folder / "diagnosis" / "model_after.yaml")
        diagnose(str(folder / "experiment"), out=str(folder / "second"), model=model, **options)
        again = json.loads((folder / "second" / "diagnosis.json").read_text())["answer"]
    error = content["error"]
    result = LoopResult(
        answer=content["answer"],
        effects=tuple(tuple(e["class"]) for e in content["effects"]),
        before=error["before"]["held_out"],
        after=error["after"]["held_out"],
        floor=(error["noise_floor"] ** 2 + error["discretisation_floor"] ** 2) ** 0.5,
        seconds=content["seconds"],
        parameters={
            f"{e['name']}.{key}": p["value"]
            for e in content["effects"]
            for key, p in e["parameters"].items()
            if not isinstance(p["value"], list)
        },
        truth=dict(UNDECLARED),
        again=again,
        picture=folder / "loop.png",
        report=folder / "diagnosis" / "report.html",
    )
    draw(folder / "diagnosis", result.picture)
    print(f"answer: {result.words} (truth: {figures(result.truth)}; found: {figures(result.parameters) or 'nothing'})")
    print(f"held-out error: {1e3 * result.before:.3g} mm before, {1e3 * result.after:.3g} mm after; floor {1e3 * result.floor:.2g} mm")
    print(f"picture: {result.picture}\ndiagnosis: {result.report}")
    return result


def figures(values: Mapping[str, float]) -> str:
    """Return names and values as one line: "drag_linear.k = 3, gravity.g = 0.1"."""
    return ", ".join(f"{name} = {value:.3g}" for name, value in values.items())


def record(
    folder: Path,
    effects: Mapping[str, float],
    *,
    launches: Sequence[Launch] = LAUNCHES,
    model: Mapping[str, Any] = ELASTIC,
    declared: Mapping[str, float] | None = None,
    scene: "Scene | None" = None,
    side: int = 5,
    frames: int = 16,
    every: int = 10,
    noise: float = 4e-4,
    seed: int = 1,
) -> "Experiment":
    """Simulate a block of particles, and write its tracked points and the declared model as an experiment folder.

    Args:
        folder: Folder to write; an earlier experiment there is replaced.
        effects: Effects that act and are not declared, by flat names.
        launches: The recordings.
        model: The true law: density, elasticity, plasticity.
        declared: Values of the declared model that differ from the true ones. None: `young` is a third too high.
        scene: Grid, step and surroundings, in truth and as declared. None: 14 cells, steps of 1 ms and no collider.
        side: Particles along each edge of the block of 0.3 m.
        frames: Number of recorded frames, the start included.
        every: Substeps between frames.
        noise: Standard deviation of the noise of each coordinate [m].
        seed: Seed of the noise and of the choice of the 60 tracked particles.

    Raises:
        UserError: The folder holds something else.
    """
    import numpy as np
    import torch

    from neuido.data.measured.experiment import Experiment, Recording, write_experiment
    from neuido.physics.effects.parameters import Effects
    from neuido.physics.laws.classical import material
    from neuido.physics.mpm.simulator import Simulator
    from neuido.types import Scene

    folder = Path(folder)
    if folder.exists() and not (folder / "experiment.yaml").is_file():
        raise UserError(f"out = {folder} holds something else: give another folder")
    scene = scene or Scene(cells=14, dt=1e-3)
    interval = every * scene.dt
    rng = np.random.default_rng(seed)
    recordings = []
    for launch in launches:
        body = _block(launch, side)
        simulator = Simulator(scene, body, density=model["density"], device="cpu")
        with torch.no_grad():
            seen = simulator.rollout(
                every * (frames - 1), *material(model["elasticity"], model["plasticity"]), every=every, effects=Effects.of(dict(effects))
            ).x
        pick = torch.from_numpy(rng.permutation(len(body.x))[:60].copy())
        x = seen[:, pick] + noise * torch.from_numpy(rng.standard_normal((frames, len(pick), 3))).float()
        recordings.append(
            Recording(
                name=launch.name,
                role=launch.role,
                scene=scene,
                frame_interval=interval,
                noise=noise,
                x=x,
                body=body,
                t=torch.arange(frames, dtype=torch.float64) * interval,
                track=pick,
            )
        )
    given = {"young": DECLARED_YOUNG} if declared is None else declared
    laws = {part: {key: given.get(key, value) for key, value in model[part].items()} for part in ("elasticity", "plasticity")}
    made = Experiment(folder.name, folder, scene, {"density": model["density"], **laws}, tuple(given) or ("young",), tuple(recordings))
    write_experiment(made, folder)
    return made


def _block(launch: Launch, side: int):
    import torch

    from neuido.types import Body

    axis = (torch.arange(side, dtype=torch.float64) + 0.5) / side * 0.3 - 0.15
    x = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    a, w = launch.stretch, launch.spin
    gradient = torch.tensor([[a, -w, 0.0], [w, -a, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    v = torch.tensor(launch.velocity, dtype=torch.float64) + x @ gradient.T
    centre = torch.tensor(launch.centre, dtype=torch.float64)
    return Body((x + centre).float(), v.float(), torch.full((len(x),), 0.027 / len(x)))


def draw(diagnosis: Path, path: Path) -> None:
    """Draw the residual on the body, what each effect would bring, and the error over time, of a written diagnosis of a body.

    Args:
        diagnosis: Folder that `neuido diagnose` wrote.
        path: The PNG picture.
    """
    import numpy as np
    from matplotlib.figure import Figure

    from neuido.discrepancy.report.wording import named, title

    content = json.loads((diagnosis / "diagnosis.json").read_text())
    trials = json.loads((diagnosis / "trace.json").read_text())["rounds"][0]["trials"]
    error = content["error"]
    names = list(error["before"]["by_recording"])
    motions = {}
    for name in names:
        with np.load(diagnosis / "predicted" / f"{name}.npz") as archive:
            motions[name] = {key: archive[key] for key in ("t", "measured", "before", "after")}
    found = " and ".join(" or ".join(map(named, e["class"])) for e in content["effects"])
    figure = Figure(figsize=(12.5, 3.1 * len(names) + 0.4), layout="constrained")
    figure.suptitle(f"{content['answer']}{': ' if found else ''}{found}", fontsize=11)
    left, right = figure.subfigures(1, 2, squeeze=False, width_ratios=(2.6, 1.0))[0]
    panels = left.subplots(len(names), 3, squeeze=False)
    longest = max(float(np.nanmax(np.abs(m["measured"][-1] - m["before"][-1]))) for m in motions.values())
    times = max((n for n in (1, 2, 5, 10, 20, 50, 100) if n * longest < 0.15), default=1)
    for row, name in zip(panels, names, strict=True):
        m = motions[name]
        rest = {when: m["measured"] - m[when] for when in ("before", "after")}
        for panel, when in zip(row, rest, strict=False):
            place, arrow = m["measured"][-1], rest[when][-1]
            panel.scatter(place[:, 0], place[:, 1], s=6, color="0.75", linewidths=0)
            panel.quiver(place[:, 0], place[:, 1], times * arrow[:, 0], times * arrow[:, 1],
                         angles="xy", scale_units="xy", scale=1, width=4e-3, color={"before": BEFORE, "after": AFTER}[when])  # fmt: skip
            own = 1e3 * error[when]["by_recording"][name]
            panel.set_title(f"{name}, {when}: {own:.2f} mm\nresidual in the last frame, times {times}", fontsize=8)
            panel.set(aspect="equal", xlabel="x [m]")
            panel.margins(0.35)
        row[0].set_ylabel("y [m]", fontsize=8)
        for when, colour in (("before", BEFORE), ("after", AFTER)):
            square = (rest[when] ** 2).sum(-1)
            seen = np.isfinite(square).any(axis=1)
            row[2].plot(m["t"][seen], 1e3 * np.nanmean(square[seen], axis=1) ** 0.5, color=colour, label=when)
        row[2].axhline(1e3 * error["noise_floor"], color="0.3", linestyle=":", linewidth=1, label="noise")
        row[2].set(xlabel="t [s]", ylim=(0, None))
        row[2].set_ylabel("RMS distance [mm]", fontsize=8)
        row[2].legend(fontsize=7, frameon=False)
        for panel in row:
            panel.tick_params(labelsize=7)
    ranks = right.subplots()
    if trials:
        trials = sorted(trials, key=lambda t: t["gain"])[-12:]
        kept = {name for e in content["effects"] for name in e["class"]}
        ranks.barh([f"{title(t['name'])}\n({t['key']})" for t in trials], [np.exp(t["gain"]) for t in trials],
                   color=[AFTER if t["name"] in kept else "0.75" for t in trials])  # fmt: skip
        ranks.axvline(1.0, color="0.3", linewidth=0.8)
        ranks.set_xlabel("error before over error after", fontsize=8)
    else:
        ranks.axis("off")
    ranks.tick_params(labelsize=6)
    write_figure(path, figure, dpi=130)
