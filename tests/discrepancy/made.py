"""Small measured folders whose undeclared effect is known, written in the three formats."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import yaml

from neuido.data.cameras import orbit
from neuido.data.formats import nerfstudio
from neuido.data.measured.experiment import Experiment, Recording, write_experiment
from neuido.data.scenes.synthetic import surround_with_gaussians
from neuido.models.render.splatting import rasterize
from neuido.physics.effects.parameters import Effects
from neuido.physics.laws.classical import material
from neuido.physics.mpm.simulator import Simulator
from neuido.types import Body, Plane, Scene

MODEL = {
    "density": 1000.0,
    "elasticity": {"law": "fixed_corotated", "young": 6e4, "poisson": 0.3},
    "plasticity": {"law": "identity"},
}


def body(velocity: tuple[float, float, float], spin: float, height: float, side: int = 5) -> Body:
    """A block of side^3 particles that flies and spins about z."""
    axis = (torch.arange(side, dtype=torch.float64) + 0.5) / side * 0.3 - 0.15
    x = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    turn = spin * torch.stack([-x[:, 1], x[:, 0], torch.zeros(len(x), dtype=torch.float64)], 1)
    v = torch.tensor(velocity, dtype=torch.float64) + turn
    return Body((x + torch.tensor([0.5, height, 0.5])).float(), v.float(), torch.full((len(x),), 0.027 / len(x)))


def experiment(
    folder: Path,
    effects: dict[str, float],
    *,
    noise: float = 4e-4,
    frames: int = 16,
    seed: int = 1,
    side: int = 5,
    laws: tuple | None = None,
) -> Experiment:
    """Write an experiment: a block thrown on a floor twice, the second time held out, with effects that are not declared.

    `laws`: what moves it, in place of `MODEL`'s.
    """
    scene = Scene(cells=14, dt=1e-3, colliders=(Plane((0.0, 0.1, 0.0), (0.0, 1.0, 0.0), "separate", 0.2),))
    rng = np.random.default_rng(seed)
    recordings = []
    for name, role, b in (
        ("throw", "fit", body((0.8, -1.5, 0.0), 6.0, 0.5, side)),
        ("drop", "held_out", body((-0.5, -2.0, 0.4), 4.0, 0.55, side)),
    ):
        simulator = Simulator(scene, b, density=1000.0, device="cpu")
        with torch.no_grad():
            pair = material(MODEL["elasticity"], MODEL["plasticity"]) if laws is None else laws
            out = simulator.rollout(10 * (frames - 1), *pair, every=10, effects=Effects.of(effects))
        pick = torch.from_numpy(rng.permutation(len(b.x))[:60].copy())
        x = out.x[:, pick] + noise * torch.from_numpy(rng.standard_normal((frames, 60, 3))).float()
        x[frames // 2, :3] = torch.nan
        recordings.append(
            Recording(
                name=name,
                role=role,
                scene=scene,
                frame_interval=0.01,
                noise=noise,
                x=x,
                body=b,
                t=torch.arange(frames, dtype=torch.float64) * 0.01,
                track=pick,
            )
        )
    given = {**MODEL, "elasticity": {**MODEL["elasticity"], "young": 7e4}}
    made = Experiment("block", folder, scene, given, ("young",), tuple(recordings))
    write_experiment(made, folder)
    return made


def filmed(
    folder: Path, effects: dict[str, float], *, particles: bool = True, views: int = 2, frames: int = 14, width: int = 96, side: int = 5,
    turn: float = 0.0,
) -> Experiment:  # fmt: skip
    """Write the block of `experiment` as silhouettes from some views, a throw and one held out; `particles`: with x0, v0 and volume.

    `turn` [degrees] is the angle by which the cameras turn about the body from the first frame to the last.
    """
    scene = Scene(cells=14, dt=1e-3, colliders=(Plane((0.0, 0.1, 0.0), (0.0, 1.0, 0.0), "separate", 0.2),))
    options = {"radius": 2.4, "elevations": (12.0, 50.0), "target": (0.5, 0.35, 0.5), "width": width, "height": width, "angle": 32.0}
    cameras = orbit(views, **options)
    if turn:
        poses = [orbit(views, start=float(start), **options).viewmats for start in np.linspace(0.0, turn, frames)]
        cameras = cameras._replace(viewmats=torch.stack(poses, 1))
    recordings = []
    for name, role, b in (
        ("throw", "fit", body((0.9, 0.6, 0.2), 5.0, 0.42, side)),
        ("drop", "held_out", body((-0.4, -1.0, 0.3), -4.0, 0.6, side)),
    ):
        simulator = Simulator(scene, b, density=1000.0, device="cpu")
        with torch.no_grad():
            out = simulator.rollout(
                20 * (frames - 1), *material(MODEL["elasticity"], MODEL["plasticity"]), every=20, effects=Effects.of(effects)
            )
        dense = surround_with_gaussians(b, 27, seed=name)
        means, covariances = dense.at(out.x, out.F)
        alphas = rasterize(means, covariances, torch.full((means.shape[1],), 0.9), dense.colour, *cameras)[1]
        shot = np.zeros((views, frames, width, width, 4), np.uint8)
        shot[..., 3] = (255 * alphas.transpose(0, 1)).round().byte().numpy()
        times = torch.arange(frames, dtype=torch.float64) * 0.02
        own = folder.with_name(f"{folder.name}-film") / name
        nerfstudio.write(own, cameras, times, shot)
        given = {"x": out.x[:, :1], "body": b, "t": times, "track": torch.zeros(1, dtype=torch.int64)} if particles else {}
        recordings.append(Recording(name=name, role=role, scene=scene, frame_interval=0.02, video=nerfstudio.read(own), **given))
    given = {**MODEL, "elasticity": {**MODEL["elasticity"], "young": 7e4}}
    made = Experiment("block", folder, scene, given, ("young",), tuple(recordings))
    write_experiment(made, folder)
    return made


def declared(made: Experiment, effects: dict[str, float]) -> Experiment:
    """The experiment with effects in its model."""
    return replace(made, model={**made.model, "effects": effects})


def track(folder: Path, *, drag: float = 0.12, bodies: int = 1, noise: float = 0.004) -> None:
    """Write a track folder: balls thrown with air drag k |v| v along x and y."""
    rng = np.random.default_rng(5)
    folder.mkdir(parents=True)
    recordings = []
    names = [f"ball-{i}" for i in range(bodies)]
    for i, name in enumerate(names):
        k = drag if i == 0 else 0.0
        for j, (v, role) in enumerate((((9.0, 6.0), "fit"), ((3.0, 8.0), "fit"), ((12.0, 2.0), "held_out"))):
            x, v, h, rows = np.array([0.0, 2.0]), np.array(v), 1e-3, []
            for n in range(1201):
                if n % 20 == 0:
                    rows.append((n * h, *(x + noise * rng.standard_normal(2))))
                for _ in range(1):
                    a = np.array([0.0, -9.81]) - k * np.linalg.norm(v) * v
                    x, v = x + h * v + 0.5 * h**2 * a, v + h * a
            np.savetxt(folder / f"{name}-{j}.csv", rows, delimiter=",", header="t,x,y", comments="")
            recordings.append({"name": f"{name}-{j}", "body": name, "file": f"{name}-{j}.csv", "columns": {"t": "t", "x": "x", "y": "y"},
                               "noise": noise, "role": role})  # fmt: skip
    content = {
        "format": "neuido-track/1", "name": "balls", "model": {"gravity": [0, -9.81, 0], "effects": {}, "free": []},
        "bodies": {name: {"mass": 0.003, "diameter": 0.04} for name in names}, "recordings": recordings,
    }  # fmt: skip
    (folder / "track.yaml").write_text(yaml.safe_dump(content, sort_keys=False))


def material_test(folder: Path, *, stiffening: float = 0.05) -> None:
    """Write a material test: incompressible neo-Hookean rubber with W + mu k / 4 (I1 - 3)^2 beside it, in two modes."""
    rng = np.random.default_rng(2)
    folder.mkdir(parents=True)
    tests = []
    for mode, role in (("uniaxial", "fit"), ("pure_shear", "fit"), ("equibiaxial", "held_out")):
        s = np.linspace(1.05, 2.2, 24)
        second = {"uniaxial": s**-0.5, "equibiaxial": s, "pure_shear": np.ones_like(s)}[mode]
        third = 1 / (s * second)
        x = s**2 + second**2 + third**2 - 3
        P = 4e5 * (1 + stiffening * x) * (s**2 - third**2) / s * (1 + 0.002 * rng.standard_normal(len(s)))
        np.savetxt(folder / f"{mode}.csv", np.stack([s, P], 1), delimiter=",", header="stretch,stress", comments="")
        tests.append(
            {"name": mode, "file": f"{mode}.csv", "mode": mode, "columns": {"stretch": "stretch", "nominal_stress": "stress"}, "role": role}
        )
    content = {
        "format": "neuido-material-test/1", "name": "rubber",
        "model": {"density": 1000.0, "elasticity": {"law": "neo_hookean", "young": 1.0e6, "poisson": 0.499},
                  "plasticity": {"law": "identity"}, "free": ["young"], "incompressible": True},
        "tests": tests,
    }  # fmt: skip
    (folder / "test.yaml").write_text(yaml.safe_dump(content, sort_keys=False))
