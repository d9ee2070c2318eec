"""Small plates with a hole whose law is known, as folders of the format `neuido-plane/1`."""

from pathlib import Path

import numpy as np
import torch
import yaml

from neuido.physics.plane.plane_law import PlaneLaw
from neuido.physics.plane.plane_specimen import PlaneMotion, PlaneSpecimen

TRUE = {"law": "decoupled_neo_hookean", "young": 2.7e6, "poisson": 0.35}
SIZE = 0.1
"""Edge of the quarter plate [m]; its hole has a tenth of it as radius."""


def mesh(around: int = 8, across: int = 6) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes (N, 2) [m] and triangles (E, 3) of a quarter plate with a hole at the origin."""
    angle = np.linspace(0, np.pi / 2, around + 1)
    ring = np.stack([np.cos(angle), np.sin(angle)], 1)
    edge = ring / np.abs(ring).max(1, keepdims=True)
    share = np.linspace(0, 1, across + 1)[:, None, None] ** 1.3
    nodes = SIZE * ((1 - share) * 0.2 * ring + share * edge).reshape(-1, 2)
    nodes[np.abs(nodes) < 1e-12] = 0.0
    at = np.arange(len(nodes)).reshape(across + 1, around + 1)
    a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]))
    return nodes, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def write_plate(
    folder: Path,
    model: dict,
    *,
    elasticity: dict = TRUE,
    effects: dict | None = None,
    noise: float = 1e-5,
    seed: int = 0,
    stretches: tuple = ((0.05, 0.1), (0.2, 0.3)),
    condition: str = "strain",
    stated: bool = True,
    scale: float = 1.0,
    order: np.ndarray | None = None,
    continues: bool = False,
) -> Path:
    """Write a plate that is pulled along x and half as much along y: load steps to fit, and further ones that are held out.

    Args:
        folder: Folder to write, new.
        model: The declared model.
        elasticity, effects: The true law.
        noise: Standard deviation of the noise of a displacement [m].
        seed: Seed of the noise.
        stretches: Displacements of the right edge relative to the size, of each recording.
        condition: `strain` or `stress`.
        stated: Whether the folder states the noise.
        scale: Factor on all lengths; forces stay those of a plate of the first size.
        order: Order of the nodes.
        continues: Whether the second recording begins where the first one ends; both begin at rest otherwise.
    """
    nodes, triangles = mesh()
    specimen = PlaneSpecimen(torch.from_numpy(nodes), torch.from_numpy(triangles), 0.002, condition)
    right, top = (np.isclose(nodes[:, a], SIZE) for a in (0, 1))
    fixed = np.stack([right | (nodes[:, 0] == 0), top | (nodes[:, 1] == 0)], 1)
    order = np.arange(len(nodes)) if order is None else order
    place = np.argsort(order)
    folder.mkdir(parents=True)
    marks = [["left" if x == 0 else "right" if r else "" for x, r in zip(nodes[:, 0], right)]]
    marks += [["bottom" if y == 0 else "top" if t else "" for y, t in zip(nodes[:, 1], top)]]
    places = (scale * nodes).tolist()
    lines = [f"{places[i][0]!r},{places[i][1]!r},{marks[0][i]},{marks[1][i]}" for i in order]
    (folder / "nodes.csv").write_text("x,y,boundary_x,boundary_y\n" + "\n".join(lines) + "\n")
    (folder / "elements.csv").write_text("node1,node2,node3\n" + "\n".join(",".join(map(str, place[t])) for t in triangles) + "\n")
    rng = np.random.default_rng(seed)
    law = PlaneLaw(elasticity, effects or {}, centres=specimen.centres)
    recordings = []
    for name, role, own in zip(("low", "high"), ("fit", "held_out"), stretches):
        before = stretches[0] if continues and name == "high" else ()
        motion = torch.tensor(np.array((*before, *own))[:, None, None] * nodes * [1.0, 0.5])
        found = PlaneMotion(*(part[len(before) :] for part in specimen.equilibrium(law, torch.from_numpy(fixed), motion)))
        motion = motion[len(before) :]
        u, files = found.displacement.numpy() + noise * rng.standard_normal(motion.shape), []
        for t, moved in enumerate(u):
            files.append(f"{name}_{t}.csv")
            (folder / files[-1]).write_text("ux,uy\n" + "\n".join(f"{scale * a!r},{scale * b!r}" for a, b in moved[order].tolist()) + "\n")
        force = found.force.numpy()
        sums = [(force[:, right, 0].sum(1), "right_x"), (force[:, top, 1].sum(1), "top_y")]
        rows = np.stack([total * (1 + 0.003 * rng.standard_normal(len(total))) for total, _ in sums], 1)
        text = ",".join(title for _, title in sums) + "\n" + "\n".join(",".join(map(repr, row)) for row in rows.tolist()) + "\n"
        (folder / f"forces_{name}.csv").write_text(text)
        entry = {"name": name, "role": role, "displacements": files, "forces": f"forces_{name}.csv"}
        entry |= {"continues": "low"} if before else {}
        recordings.append(entry | ({"noise": {"displacement": noise * scale}} if stated else {}))
    content = {"format": "neuido-plane/1", "name": "plate", "model": model, "boundary": {"left_x": "held", "bottom_y": "held"}}
    content |= {"specimen": {"nodes": "nodes.csv", "elements": "elements.csv", "thickness": 0.002 * scale, "condition": condition}}
    (folder / "plane.yaml").write_text(yaml.safe_dump(content | {"recordings": recordings}, sort_keys=False))
    return folder
