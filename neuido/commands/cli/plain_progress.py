"""Progress of a trainer where there is no terminal: a plain line every half minute in the place of a bar."""

import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from neuido.data.progress import Progress

if TYPE_CHECKING:
    from lightning.pytorch import Callback, LightningModule, Trainer


def needs_plain_lines(trainer: Mapping[str, Any]) -> bool:
    """Return whether a trainer of this configuration would draw its bar into a file or a pipe."""
    own = trainer.get("callbacks") or []
    given = any("ProgressBar" in str(getattr(each, "class_path", each)) for each in (own if isinstance(own, list) else [own]))
    return not sys.stdout.isatty() and trainer.get("enable_progress_bar") is not False and not given


def plain_progress() -> "Callback":
    """Return the callback that a trainer takes in the place of its bar."""
    from lightning.pytorch.callbacks import ProgressBar

    class PlainProgress(ProgressBar):
        work: Progress | None = None
        is_enabled = False  # no bar that `LightningModule.print` would have to keep whole: it prints as it is

        def _begin(self, what: str, total: float | None, done: int = 0) -> None:
            self._end()
            known = int(total) if total is not None and 0 < total < float("inf") else None
            self.work = Progress(what, known, unit="steps" if what == "fit" else "batches", done=done)
            self.work.__enter__()

        def _end(self) -> None:
            if self.work is not None:
                self.work.close()
                self.work = None

        def disable(self) -> None:  # on every rank but the first
            self._end()

        def on_train_start(self, trainer: "Trainer", pl_module: "LightningModule") -> None:
            if trainer.is_global_zero:
                known = pl_module.automatic_optimization  # else a step may be several of the optimisers'
                self._begin("fit", trainer.estimated_stepping_batches if known else None, trainer.global_step)

        def on_train_batch_end(self, trainer: "Trainer", pl_module: "LightningModule", *_: Any) -> None:
            if self.work is not None:
                self.work.move_to(trainer.global_step)
                shown = self.get_metrics(trainer, pl_module)
                figures = [f"{name} {value:.4g}" for name, value in shown.items() if isinstance(value, int | float) and name != "v_num"]
                self.work.say(", ".join([f"epoch {trainer.current_epoch}", *figures]))

        def on_test_start(self, trainer: "Trainer", pl_module: "LightningModule") -> None:
            self._begin_loop(trainer, "test", trainer.num_test_batches)

        def on_predict_start(self, trainer: "Trainer", pl_module: "LightningModule") -> None:
            self._begin_loop(trainer, "predict", trainer.num_predict_batches)

        def on_validation_start(self, trainer: "Trainer", pl_module: "LightningModule") -> None:
            if trainer.state.fn == "validate":
                self._begin_loop(trainer, "validate", trainer.num_val_batches)

        def _begin_loop(self, trainer: "Trainer", what: str, batches: Any) -> None:
            if trainer.is_global_zero:
                self._begin(what, sum(batches) if isinstance(batches, list) else batches)

        def on_test_batch_end(self, trainer: "Trainer", *_: Any) -> None:
            if self.work is not None:
                self.work.update()

        def on_predict_batch_end(self, trainer: "Trainer", *_: Any) -> None:
            self.on_test_batch_end(trainer)

        def on_validation_batch_end(self, trainer: "Trainer", *_: Any) -> None:
            if self.work is not None and trainer.state.fn == "validate":
                self.work.update()

        def teardown(self, trainer: "Trainer", pl_module: "LightningModule", stage: str) -> None:
            self._end()

        def on_exception(self, trainer: "Trainer", pl_module: "LightningModule", exception: BaseException) -> None:
            self._end()

    return PlainProgress()
