"""Signals that end a command: it stops where its state is whole, says how to go on, and exits with 128 + n."""

import contextlib
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lightning.pytorch import Callback

SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
STATE = "interrupted.ckpt"
"""What a trainer leaves that was interrupted, in the folder of its checkpoints."""

_received: list[int] = []
_patient: list[object] = []


class Interrupted(KeyboardInterrupt):
    """A signal came that ends the command."""


def received() -> int | None:
    """Return the number of the first signal that asked this command to end, or None."""
    return _received[0] if _received else None


@contextlib.contextmanager
def watched() -> Iterator[None]:
    """Turn SIGINT, SIGTERM and SIGHUP into `Interrupted` while this is open; one that was ignored before (nohup) still is.

    A trainer that is `stop_at_step` ends by itself after its batch; a second signal ends it at once. A signal that comes while this closes
    is noted (`received`), so that the earlier handlers are restored whole.
    """
    owner, closing = os.getpid(), False

    def handle(number: int, frame: Any) -> None:
        if os.getpid() != owner:  # a worker, forked from this process
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
            return
        again = bool(_received)
        _received.append(number)
        if not closing and (not _patient or again):
            raise Interrupted(signal.Signals(number).name)

    before = {}
    _received.clear()
    _patient.clear()
    try:
        with contextlib.suppress(ValueError):  # not the main thread: whoever runs this has signals of its own
            for number in SIGNALS:
                if (handler := signal.getsignal(number)) not in (signal.SIG_IGN, None):
                    before[number] = handler
                    signal.signal(number, handle)
        yield
    finally:
        closing = True
        for number, handler in before.items():
            signal.signal(number, handler)


def stop_at_step(path: Path | None = None) -> "Callback":
    """Build a callback that ends training after the batch in which a signal came, and saves the state.

    Args:
        path: The file; `interrupted.ckpt` beside the trainer's other checkpoints where absent.
    """
    from lightning.pytorch import Callback, LightningModule, Trainer
    from lightning.pytorch.utilities.exceptions import SIGTERMException

    class StopAtStep(Callback):
        def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
            _patient.append(self)

        def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
            _patient.clear()

        def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
            _patient.clear()
            if isinstance(exception, SIGTERMException):  # Lightning ends a fit by itself where SIGTERM comes between two of these hooks
                self._save(trainer)

        def on_train_batch_end(self, trainer: Trainer, *_: Any) -> None:
            self._stop(trainer)

        def on_validation_end(self, trainer: Trainer, *_: Any) -> None:
            self._stop(trainer)

        def on_test_batch_end(self, trainer: Trainer, *_: Any) -> None:
            self._stop(trainer)

        def on_predict_batch_end(self, trainer: Trainer, *_: Any) -> None:
            self._stop(trainer)

        def _stop(self, trainer: Trainer) -> None:
            if _received:
                self._save(trainer)
                raise Interrupted(signal.Signals(_received[0]).name)

        def _save(self, trainer: Trainer) -> None:
            if trainer.state.fn == "fit" and not trainer.sanity_checking:
                file = path or _place(trainer) / STATE
                trainer.save_checkpoint(file)
                print(f"neuido: the state after step {trainer.global_step} is in {file}: --ckpt_path goes on from it", file=sys.stderr)

    return StopAtStep()


def log_folder(trainer: Any) -> str | None:
    """Return the folder of the first logger; `Trainer.log_dir` waits for all processes of a training, of which others may have ended."""
    if not trainer.loggers:
        return None
    return getattr(trainer.loggers[0], "log_dir", None) or trainer.loggers[0].save_dir


def _place(trainer: Any) -> Path:
    folder = getattr(trainer.checkpoint_callback, "dirpath", None)
    return Path(folder or log_folder(trainer) or trainer.default_root_dir)
