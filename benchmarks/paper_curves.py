"""Draw the Chamfer distance over time of the six scenes (paper, Fig. 10) from runs of `neuido fit`.

    python benchmarks/paper_curves.py --curves "zero-shot=runs/adapt:before" "few-shot=runs/adapt:after" --out cd_over_time.png

A run is the folder `out` of a fit or test. Each of its scenes has particles.csv in a folder named for the stage.
"""

import argparse
import csv
from pathlib import Path

from matplotlib.figure import Figure

SCENES = ("BouncyBall", "ClayCat", "HoneyBottle", "JellyDuck", "RubberPawn", "SandFish")


def curve_of(run: Path, scene: str, stage: str) -> tuple[list[int], list[float]]:
    """Return the frames of a scene and their Chamfer distances; nothing where the run does not have the scene."""
    file = run / scene / stage / "particles.csv"
    if not file.is_file():
        return [], []
    with file.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    return [int(row["frame"]) for row in rows], [float(row["cd"]) for row in rows]


def draw(curves: list[tuple[str, str, str]]) -> Figure:
    """Return a figure with one panel for each scene.

    Args:
        curves: Title, folder of the run (`{scene}` in it stands for the name of a scene) and stage of each curve.
    """
    figure = Figure(figsize=(10, 5.4), layout="constrained")
    panels = figure.subplots(2, 3, sharex=True)
    for panel, scene in zip(panels.flat, SCENES):
        for title, run, stage in curves:
            frames, values = curve_of(Path(run.format(scene=scene)), scene, stage)
            if frames:
                panel.plot(frames, values, label=title, linewidth=1.2)
        panel.set_title(scene, fontsize=10)
        heights = [value for line in panel.lines for value in line.get_ydata()]
        if heights and max(heights) > 10 * min(heights):
            panel.set_yscale("log")
        panel.grid(alpha=0.3)
    for panel in panels[1]:
        panel.set_xlabel("frame")
    for panel in panels[:, 0]:
        panel.set_ylabel("Chamfer distance [1e-4]")
    handles = {label: handle for panel in panels.flat for handle, label in zip(*panel.get_legend_handles_labels())}
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=len(handles))
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--curves", nargs="+", required=True, metavar="TITLE=RUN:STAGE")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    curves = []
    for given in options.curves:
        title, _, rest = given.partition("=")
        run, _, stage = rest.rpartition(":")
        curves.append((title, run, stage))
    draw(curves).savefig(options.out, dpi=110)


if __name__ == "__main__":
    main()
