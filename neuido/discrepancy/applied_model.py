"""Use of a diagnosed model: simulation of an experiment's recordings, and its effects beside a law that is fitted to images."""

import os
from dataclasses import replace
from pathlib import Path

from neuido.data.files.output_folder import check_unused
from neuido.data.files.writing import new_folder
from neuido.data.measured.experiment import Recording, read_experiment, write_experiment
from neuido.data.progress import Progress
from neuido.discrepancy.problems.declared_model import beside, read_model_file, ready
from neuido.discrepancy.workflow import choose_device, experiment_problem
from neuido.models.inference.prepared_scene import EffectSource, PreparedScene
from neuido.physics.effects.parameters import Effects
from neuido.physics.mpm.simulator import Simulator
from neuido.physics.runtime.events import Event


def replay(
    folder: str, out: str | os.PathLike, *, model: str | None = None, device: str = "auto", progress: bool = True
) -> tuple[dict[str, float | None], dict[str, list[Event]]]:
    """Simulate the recordings of an experiment with a model, and write them as an experiment folder without noise.

    The folder has the tracked points of the experiment. For videos without tracked points it has all particles.

    Args:
        folder: Folder of the experiment.
        out: Folder to write. It appears when it is complete.
        model: File with the model, for example a model_after.yaml. None: the model of the experiment.
        device: auto, cpu or cuda.
        progress: Show a progress bar.

    Returns:
        The RMS distance between simulated and measured points of each recording [m], None where no points were tracked; and the events
        that make a motion doubtful, of the recordings that have any.

    Raises:
        UserError: The experiment or model cannot be read or simulated, or the output folder is there already.
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
        read_experiment(hidden)  # a folder that cannot be read again does not appear
    return {r.name: _distance(r, experiment[r.name]) for r in recordings}, doubtful


def _distance(simulated: Recording, measured: Recording) -> float | None:
    """Return the RMS distance between simulated and measured points [m]; None where their numbers differ or none were tracked."""
    if measured.x is None or simulated.x is None or measured.x.shape != simulated.x.shape:
        return None
    return float((simulated.x - measured.x)[measured.seen].square().sum(-1).mean().sqrt())


class DiagnosedEffects(EffectSource):
    """The effects of a model without its law, for fits of a law to images.

    Args:
        path: A `model_after.yaml` of `neuido diagnose`, or a file with the key `model`.

    Raises:
        UserError: No such file, an impossible material, an unknown effect.
    """

    def __init__(self, path: str):
        self.model = read_model_file(path)
        self._made: tuple[Simulator, Effects] | None = None

    def of(self, scene: PreparedScene) -> Effects:
        """Return the effects for the body of a scene."""
        if self._made is None or self._made[0] is not scene.simulator:
            times = scene.source.batch.times
            effects = ready(self.model, scene.simulator, duration=float(times[-1] - times[0])).effects
            self._made = scene.simulator, effects
        return self._made[1]
