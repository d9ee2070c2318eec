"""A full disk: every writer of results raises an error that is told in one line, and leaves no file under its final name that is cut."""

import os
import resource
import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from neuido.data.files.writing import copy_file, write_arrays, write_figure, write_png, write_text
from neuido.discrepancy.report.diagnosis import Diagnosis
from neuido.errors import one_line
from neuido.models.inference.outputs import contact_sheet, write_particles, write_video
from neuido.models.render.gaussians import attach_gaussians, save_gaussians
from neuido.types import ParticleState
from tests.faults.readers import READERS

NOISE = torch.rand(6, 64, 96, 3, generator=torch.Generator().manual_seed(0))
PIXELS = (255 * NOISE[0]).byte().numpy()
X = torch.rand(1, 4000, 3, generator=torch.Generator().manual_seed(1))


def _figure(path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure()
    figure.subplots().plot(np.random.default_rng(0).random(2000))
    write_figure(path, figure, dpi=150)


def _report(path: Path) -> None:
    Diagnosis.read(path.parent.parent / "results").report(path)


WRITERS: dict[str, Callable[[Path], object]] = {
    "text": lambda path: write_text(path, "x" * 20_000),
    "arrays": lambda path: write_arrays(path, {"x": X.numpy()}),
    "picture": lambda path: write_png(path, PIXELS),
    "figure": _figure,
    "copy": lambda path: copy_file(__file__, path),
    "video": lambda path: write_video(path.with_suffix(".mp4"), NOISE),
    "contact sheet": lambda path: contact_sheet(path, [NOISE]),
    "point clouds": lambda path: write_particles(path.parent, ParticleState(X, X, None, None)),  # type: ignore[arg-type]
    "Gaussians": lambda path: save_gaussians(path, attach_gaussians(X[0], torch.full((4000,), 1e-6))),
    "report": _report,
}


@pytest.mark.parametrize("name", WRITERS)
def test_writers_on_a_full_disk(name, tmp_path):
    """The process that writes is a fork whose files may not exceed 2 kB."""
    out = tmp_path / "out"
    out.mkdir()
    (tmp_path / "results").mkdir()
    READERS["diagnosis"].make(tmp_path / "results")
    (tmp_path / "results" / "report.html").write_text("x" * 20_000)
    child = os.fork()
    if child == 0:
        status = 1
        try:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (2_000, resource.RLIM_INFINITY))
            WRITERS[name](out / "file")
        except BaseException as error:
            status = 7 if one_line(error) else 8  # type: ignore[arg-type]
        finally:
            os._exit(status)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
    assert not list(out.iterdir())
