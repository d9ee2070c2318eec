"""What a diagnosis has found, for a law that is fitted to images: the effects of its `model_after.yaml` act on top of the law."""

from neuido.discrepancy.believed import read_model_file, ready
from neuido.models.fewshot.scene_fit import EffectSource
from neuido.models.inference.prepared_scene import PreparedScene
from neuido.physics.effects.parameters import Effects
from neuido.physics.mpm.simulator import Simulator


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
