"""Generate the Stage I trajectories for `neuido trajectories`: plan, simulation and files.

`trajectory_files.py` describes the folder.
"""

import contextlib
import math
import os
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from neuido.data.bodies.families import PARAMETERS, PUBLISHED, check_ranges, draw_parameters, effects, laws, sample_laws
from neuido.data.bodies.shapes import cube
from neuido.data.files.output_folder import claimed_folder
from neuido.data.files.writing import atomic_write, is_as_written, sha256_of, write_json
from neuido.data.progress import Progress
from neuido.data.trajectories.reference_viscosity import reference_viscosity
from neuido.data.trajectories.trajectory_files import COLUMNS, FORMAT, is_complete
from neuido.errors import UserError
from neuido.physics.effects.parameters import Effects
from neuido.physics.laws.base import ElasticLaw, PlasticLaw
from neuido.physics.mpm.simulator import Simulator
from neuido.physics.runtime.device import choose_device
from neuido.physics.runtime.events import OUTSIDE, Event
from neuido.physics.runtime.limits import check_limit, check_memory
from neuido.types import Body, ParticleState, Scene, Vector, Walls

SEGMENT = 100  # substeps held in memory at a time
SAMPLE_BYTES = 800
"""Memory of a particle in a substep that is held [bytes]: its state twice, and what is recorded, partly in float64."""


@dataclass(frozen=True)
class Setup:
    """Options that determine the content of the files; `neuido trajectories --help` explains each one."""

    families: dict[str, dict[str, tuple[float, float]]]
    instances: int
    held_out: int
    seed: int
    length: float
    particles_per_side: int
    velocity: Vector
    angular_velocity: Vector
    density: float
    gravity: Vector
    cells: int
    wall_inset: float
    dt: float
    steps: int
    record_every: int

    def __post_init__(self) -> None:
        for name, lowest in (("instances", 1), ("held_out", 0), ("seed", 0), ("cells", 4), ("steps", 1), ("record_every", 1)):
            if getattr(self, name) < lowest:
                raise UserError(f"{name} must be at least {lowest}, got {getattr(self, name)}")
        check_limit(
            self.particles_per_side**3, "NEUIDO_MAX_PARTICLES", f"particles_per_side = {self.particles_per_side}: too many particles"
        )
        check_limit(self.steps, "NEUIDO_MAX_STEPS", f"steps is {self.steps}")
        count = (self.instances + self.held_out) * len(self.families)
        check_limit(count, "NEUIDO_MAX_TRAJECTORIES", f"instances and held_out of {len(self.families)} families are {count} trajectories")
        for name in ("density", "dt"):
            if not 0 < getattr(self, name) < math.inf:
                raise UserError(f"{name} must be positive, got {getattr(self, name)}")
        if self.record_every > self.steps:
            raise UserError(
                f"record_every = {self.record_every} exceeds steps = {self.steps}, so nothing is recorded: lower it or raise steps"
            )
        if not self.families:
            raise UserError(f"families is empty: give at least one of {', '.join(PARAMETERS)}")
        for family, ranges in self.families.items():
            check_ranges(family, ranges)

    @property
    def scene(self) -> Scene:
        """Scene with the box into which the cube is thrown."""
        walls = Walls(contact="separate", friction=0.0, inset=self.wall_inset)
        return Scene(cells=self.cells, dt=self.dt, gravity=self.gravity, walls=walls)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape of the array of a trajectory: recorded substeps, particles, columns."""
        return self.steps // self.record_every, self.particles_per_side**3, COLUMNS


@dataclass(frozen=True)
class Instance:
    """One trajectory of the plan: its name, material and split (`train` or `held_out`)."""

    name: str
    family: str
    parameters: dict[str, float]
    split: str


def plan(setup: Setup) -> list[Instance]:
    """List all trajectories in file order: the training instances by family, then the held-out instances by family."""
    made = []
    for split, numbers in (
        ("train", range(setup.instances)),
        ("held_out", range(setup.instances, setup.instances + setup.held_out)),
    ):
        made += [_instance(setup, family, number, split) for family in PARAMETERS if family in setup.families for number in numbers]
    return made


def generate(
    setup: Setup, out: str | os.PathLike, *, shard: int = 0, shards: int = 1, device: str = "auto", batch: int = 0, progress: bool = True
) -> None:
    """Simulate the missing trajectories of one shard; write `index.json` when all trajectories are complete.

    Args:
        setup: Options that determine the content.
        out: Output folder.
        shard: Number of the shard, from 0.
        shards: Number of shards; trajectory i belongs to shard i modulo `shards`.
        device: auto, cpu or cuda.
        batch: Trajectories per launch; 0: 1 on the CPU and 10 on a GPU.
        progress: Show a progress bar.

    Raises:
        UserError: `shard`, `batch` or `device` is invalid, `out` cannot be written or holds trajectories of other options, or the
            simulation fails (a substep above the stability limit, a NaN); or the options exceed a limit of `physics/runtime/limits.py`.
    """
    if not 0 <= shard < shards:
        raise UserError(f"shard must lie in 0..{shards - 1} (shards = {shards}), got {shard}")
    if batch < 0:
        raise UserError(f"batch must be 0 (automatic) or positive, got {batch}")
    chosen = choose_device(device)
    size = batch or (10 if chosen.type == "cuda" else 1)
    particles = size * setup.shape[1]
    what = f"a batch of {size} trajectories of {setup.shape[1]} particles, {_segment(setup)} substeps at a time,"
    check_memory(SAMPLE_BYTES * particles * _segment(setup), chosen, what, "lower batch, particles_per_side or record_every")
    instances = plan(setup)
    _check_steps(setup, instances)
    folder = Path(out)
    content = {"format": FORMAT, "setup": asdict(setup), "trajectories": [asdict(instance) for instance in instances]}
    held = "trajectories of other options"
    with claimed_folder(folder, content, held, compared="setup", shard=shard, shards=shards):
        files = {instance.name: folder / f"{instance.name}.npy" for instance in instances}

        in_shard = [instance for i, instance in enumerate(instances) if i % shards == shard]
        published = (folder / "index.json").is_file()  # by an earlier version, maybe, which noted no digests

        def whole(path: Path) -> bool:
            return is_complete(path, setup.shape) and is_as_written(path, unnoted=published)

        missing = [instance for instance in in_shard if not whole(files[instance.name])]
        with Progress("trajectories", len(in_shard), done=len(in_shard) - len(missing), shown=progress) as work:
            for family in PARAMETERS:
                in_family = [instance for instance in missing if instance.family == family]
                for start in range(0, len(in_family), size):
                    group = in_family[start : start + size]
                    for path in (files[instance.name] for instance in group):
                        if path.exists():
                            work.print(f"{path.name} is not as it was written: it is simulated again")
                    for event in _simulate(setup, group, [files[instance.name] for instance in group], chosen):
                        work.print(f"note: {group[event.scene].name}: {event.words}")
                    work.update(len(group))

        if missing or not (folder / "index.json").exists():
            if all(whole(path) for path in files.values()):
                _write_index(folder, setup, instances)


def _body(setup: Setup) -> Body:
    return cube(
        length=setup.length,
        particles_per_side=setup.particles_per_side,
        velocity=setup.velocity,
        angular_velocity=setup.angular_velocity,
    )


def _check_steps(setup: Setup, instances: list[Instance]) -> None:
    """Check that the substep is stable for every instance before any is simulated."""
    simulator = Simulator(setup.scene, _body(setup), density=setup.density, device="cpu")
    for instance in instances:
        given = instance.family, [instance.parameters]
        try:
            rates = _rate_effects(*given)
            simulator.check_step(laws(*given)[0], None if rates is None else rates.viscosity(1, simulator.mass))
        except UserError as error:
            raise UserError(f"{instance.name}: {error}") from error


def _rate_effects(family: str, parameters: list[dict[str, float]]) -> Effects | None:
    """Return the effects of a family without the hardening of snow: samples of F and stress do not know its history."""
    given = effects(family, parameters)
    return None if given is None or given.compaction_hardening is not None else given


def _segment(setup: Setup) -> int:
    """Return how many substeps are in memory at a time, a multiple of `record_every`."""
    return max(setup.record_every, SEGMENT // setup.record_every * setup.record_every)


def _simulate(setup: Setup, group: list[Instance], paths: list[Path], device: torch.device) -> list[Event]:
    """Simulate instances of one family in one launch; write their files one segment of substeps at a time.

    Returns:
        What makes trajectories doubtful; the scene of an event is the place in the group, and its particle is counted in the trajectory.
    """
    noted: dict[tuple[int, str], Event] = {}
    frames, count, _ = setup.shape
    body = _body(setup)
    given = group[0].family, [instance.parameters for instance in group]
    (elastic, plastic), rates = laws(*given), _rate_effects(*given)
    exact = [laws(instance.family, [instance.parameters]) for instance in group]
    segment = _segment(setup)
    names = group[0].name if len(group) == 1 else f"{group[0].name} .. {group[-1].name}"
    header = {"descr": "<f4", "fortran_order": False, "shape": setup.shape}
    try:
        simulator = Simulator([setup.scene] * len(group), [body] * len(group), density=setup.density, device=device)
        state = simulator.state
        with torch.no_grad(), contextlib.ExitStack() as stack:
            hidden = [stack.enter_context(atomic_write(path, digest=True)) for path in paths]
            files = [stack.enter_context(path.open("wb")) for path in hidden]
            for file in files:
                np.lib.format.write_array_header_1_0(file, header)
            for start in range(0, frames * setup.record_every, segment):
                steps = min(segment, frames * setup.record_every - start)
                out = simulator.rollout(steps, elastic, plastic, state=state, effects=rates)
                state = ParticleState(*(part[-1].clone() for part in out))
                for event in out.events:
                    _merge(noted, event._replace(first=event.first - event.scene * count), start, setup.dt)
                for k, file in enumerate(files):
                    own = slice(k * count, (k + 1) * count)
                    file.write(_samples(setup, out.F[:, own], out.C[:, own], *exact[k]).cpu().numpy().tobytes())
    except UserError as error:
        raise UserError(f"{names}: {error}") from error
    except OSError as error:
        raise UserError(f"{names}: cannot write to {paths[0].parent}: {str(error.strerror).lower()}: give another out") from error
    return list(noted.values())


def _merge(noted: dict[tuple[int, str], Event], event: Event, start: int, dt: float) -> None:
    """Add an event of a segment that begins at a substep to those of the segments before."""
    earlier = noted.setdefault((event.scene, event.kind), event._replace(step=event.step + start, time=event.time + start * dt))
    worst = (max if event.kind == OUTSIDE else min)(earlier.extreme, event.extreme)
    noted[event.scene, event.kind] = earlier._replace(count=max(earlier.count, event.count), extreme=worst)


def _samples(setup: Setup, F: Tensor, C: Tensor, elastic: ElasticLaw, plastic: PlasticLaw) -> Tensor:
    """Compute the recorded columns (T, P, 27) from the frames F, C (K, P, 3, 3) of a rollout.

    The targets are exact for the stored inputs, from which the F of the rollout itself differs by rounding.
    """
    last = torch.arange(setup.record_every, len(F), setup.record_every, device=F.device)
    sampled = sample_laws(elastic, plastic, F[last - 1], C[last], setup.dt)
    return torch.cat([part.flatten(-2) for part in sampled], dim=-1)


def _instance(setup: Setup, family: str, number: int, split: str) -> Instance:
    if number == 0 and family in PUBLISHED:
        name, parameters = PUBLISHED[family]
        return Instance(name, family, dict(parameters), split)
    random = np.random.default_rng([setup.seed, list(PARAMETERS).index(family), number])
    return Instance(f"{family}-{number:03d}", family, draw_parameters(family, setup.families[family], random), split)


def _write_index(folder: Path, setup: Setup, instances: list[Instance]) -> None:
    from neuido.installation import __version__

    files = {instance.name: folder / f"{instance.name}.npy" for instance in instances}
    entries = [
        {**asdict(i), **_statistics(files[i.name]), "viscosity": _viscosity(i), "sha256": sha256_of(files[i.name])} for i in instances
    ]
    write_json(folder / "index.json", {"format": FORMAT, "version": __version__, "setup": asdict(setup), "trajectories": entries})


def _viscosity(instance: Instance) -> float:
    """Return the `reference_viscosity` of an instance [Pa s]."""
    return reference_viscosity(_rate_effects(instance.family, [instance.parameters]))


def _statistics(path: Path) -> dict[str, float]:
    """Compute the RMS over all samples of the Frobenius norm of the stress [Pa] and of the plastic correction F_hat - F_tr [-]."""
    array = np.load(path, mmap_mode="r")
    stress = residual = 0.0
    for rows in np.array_split(array, max(1, len(array) // 100)):
        rows = rows.astype(np.float64)
        stress += float(np.square(rows[..., 18:]).sum())
        residual += float(np.square(rows[..., 9:18] - rows[..., :9]).sum())
    count = array.shape[0] * array.shape[1]
    return {"stress_rms": math.sqrt(stress / count), "residual_rms": math.sqrt(residual / count)}
