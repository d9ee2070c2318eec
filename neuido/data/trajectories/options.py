"""Options of `neuido trajectories`: signatures and help only, so that `--help` does not load torch."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

Range = tuple[float, float]

FAMILIES: dict[str, dict[str, Range]] = {
    "elastic": {"young": (3e4, 1e6), "poisson": (0.1, 0.4)},
    "plasticine": {"young": (1e5, 1e6), "poisson": (0.1, 0.4), "yield_stress": (1e3, 2e4)},
    "sand": {"young": (1e5, 1e6), "poisson": (0.1, 0.4), "friction_angle": (15.0, 45.0)},
}
"""Parameter ranges: young and yield_stress [Pa] drawn log-uniformly, poisson [-] and friction_angle [degrees] uniformly."""


@dataclass(frozen=True)
class Throw:
    """Cube, throw, box and substeps of the Stage I trajectories.

    Args:
        length: Edge of the cube, m; it starts in the middle of the unit cube.
        particles_per_side: Particles along an edge.
        velocity: Velocity of the cube at the start, m/s.
        angular_velocity: Angular velocity of the cube at the start, rad/s.
        density: Density, kg/m^3.
        gravity: Gravity, m/s^2.
        cells: Grid cells along the unit cube.
        wall_inset: Distance of the frictionless walls from the faces of the domain, in cells.
        dt: Time of a substep, s.
        steps: Number of substeps of a trajectory.
        record_every: Record every n-th substep.
    """

    length: float = 0.5
    particles_per_side: int = 10
    velocity: tuple[float, float, float] = (1.0, -1.5, -2.0)
    angular_velocity: tuple[float, float, float] = (4.0, 4.0, 4.0)
    density: float = 1000.0
    gravity: tuple[float, float, float] = (0.0, -9.8, 0.0)
    cells: int = 20
    wall_inset: float = 2.0
    dt: float = 5e-4
    steps: int = 1000
    record_every: int = 1


def make_trajectories(
    out: str,
    *,
    families: dict[str, dict[str, Range]] = FAMILIES,
    instances: int = 30,
    held_out: int = 10,
    seed: int = 0,
    setup: Throw | Mapping[str, Any] = Throw(),
    shard: int = 0,
    shards: int = 1,
    device: str = "auto",
    batch: int = 0,
    progress: bool = True,
    **throw: Any,
) -> None:
    """Simulate the constitutive trajectories of Stage I: a spinning cube is thrown into a box, for many materials.

    The options are those of `neuido trajectories`.

    Args:
        out: Output folder.
        families: Parameter ranges of each family.
        instances: Training instances of each family.
        held_out: Additional instances of each family that are never used for training.
        seed: Seed of the parameters.
        setup: Cube, throw, box and substeps.
        shard: Number of the shard to simulate, from 0.
        shards: Number of shards.
        device: auto, cpu or cuda.
        batch: Trajectories simulated in one launch; 0: 1 on the CPU and 10 on a GPU.
        progress: Show a progress bar.
        throw: Fields of `Throw` that differ from `setup`.

    Raises:
        UserError: A parameter range is invalid, the substep is above the stability limit, or the folder holds trajectories of other
            options.
    """
    from neuido.data.trajectories.generation import Setup, generate

    chosen = replace(setup, **throw) if isinstance(setup, Throw) else Throw(**{**setup, **throw})
    vectors = {name: tuple(getattr(chosen, name)) for name in ("velocity", "angular_velocity", "gravity")}
    plan = Setup(
        families={family: {name: (low, high) for name, (low, high) in ranges.items()} for family, ranges in families.items()},
        instances=instances,
        held_out=held_out,
        seed=seed,
        **{**asdict(chosen), **vectors},
    )
    generate(plan, out, shard=shard, shards=shards, device=device, batch=batch, progress=progress)
