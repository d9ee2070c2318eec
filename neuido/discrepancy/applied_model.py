"""A model applied: recordings simulated under it, and its effects on top of a law that is fitted to images."""

import os
from dataclasses import replace
from pathlib import Path

from neuido.data.files.output_folder import check_unused
from neuido.data.files.writing import new_folder
from neuido.data.measured.experiment import Recording, read_experiment, write_experiment
from neuido.data.progress import Progress
from neuido.discrepancy.problems.declared_model import beside, read_model_file, ready
from neuido.discrepancy.workflow import choose_device, experiment_problem
from neuido.models.fewshot.scene_fit import EffectSource
from neuido.models.inference.prepared_scene import PreparedScene
from neuido.physics.effects.parameters import Effects
from neuido.physics.mpm.simulator import Simulator
from neuido.physics.runtime.events import Event


def replay(
    folder: str, out: str | os.PathLike, *, model: str | None = None, device: str = "auto", progress: bool = True
) -> tuple[dict[str, float | None], dict[str, list[Event]]]:
    """Simulate the recordings of an experiment under a model, and write them as an experiment's folder without noise.

    The tracked points are those of the experiment; of a video, whose points nobody tracked, they are all particles.

    Args:
        folder: The experiment.
        out: Folder to write; it appears when it is whole.
        model: File with the model, for example a model_after.yaml; the experiment's own where absent.
        device: auto, cpu or cuda.
        progress: Show a progress bar.

    Returns:
        The RMS distance of each recording's points from the measured ones [m], none where no points were tracked; and what makes the
        motion of a recording doubtful, where there is anything.

    Raises:
        UserError: What readers and rollouts refuse, or a folder that is there already.
    """
    target = Path(out).expanduser()
    check_unused(target)
    experiment = read_experiment(folder, model=None if model is None else read_model_file(model))
    problem = experiment_problem(experiment, "auto", choose_device(device))
    recordings, doubtful = [], dict[str, list[Event]]()
    with new_folder(target) as hidden:
        with Progress("recordings", len(problem.measured), shown=progress) as work:
            for n in range(len(problem.measured)):
                recordings.append(problem.simulated(n))
                if events := problem.doubts({}, n):
                    doubtful[recordings[-1].name] = events
                work.update()
        write_experiment(replace(experiment, model=beside(hidden, experiment.model), recordings=tuple(recordings)), hidden)
        read_experiment(hidden)  # what cannot be read again is not published
    return {r.name: _distance(r, experiment[r.name]) for r in recordings}, doubtful


def _distance(simulated: Recording, measured: Recording) -> float | None:
    """Return the RMS distance of the points of a recording from those of another [m]."""
    if measured.x is None or simulated.x is None or measured.x.shape != simulated.x.shape:
        return None
    return float((simulated.x - measured.x)[measured.seen].square().sum(-1).mean().sqrt())


class DiagnosedEffects(EffectSource):
    """The effects of a model; its law is left aside.

    Args:
        path: A `model_after.yaml` of `neuido diagnose`, or a file with the key `model`.

    Raises:
        UserError: No such file, an impossible material, an unknown effect.
    """

    def __init__(self, path: str):
        self.model = read_model_file(path)
        self._made: tuple[Simulator, Effects] | None = None

    def of(self, scene: PreparedScene) -> Effects:
        """The effects on the scene's body."""
        if self._made is None or self._made[0] is not scene.simulator:
            times = scene.source.batch.times
            effects = ready(self.model, scene.simulator, duration=float(times[-1] - times[0])).effects
            self._made = scene.simulator, effects
        return self._made[1]
