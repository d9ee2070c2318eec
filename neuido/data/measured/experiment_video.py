"""Reader of the video of one recording in an experiment folder; `read_experiment` reads the whole experiment."""

from dataclasses import replace
from pathlib import Path

from neuido.data.formats.layout import MultiView
from neuido.data.measured.experiment import read_experiment
from neuido.errors import UserError


def read(path: Path, *, recording: str | None = None, frame_interval: float | None = None) -> MultiView:
    """Read the cameras and images of a recording, with its particles and Gaussians.

    Args:
        path: The experiment folder.
        recording: Name of the recording. Needed if several recordings have images.
        frame_interval: Not accepted, because `transforms.json` has the times.

    Raises:
        UserError: As `read_experiment`; or the recording has no images, or `frame_interval` is given.
    """
    if frame_interval is not None:
        raise UserError("frame_interval cannot be given for an experiment: its transforms.json has the times")
    experiment = read_experiment(path)
    filmed = [one.name for one in experiment.recordings if one.video is not None]
    if recording is None and len(filmed) != 1:
        raise UserError(f"{path} has {len(filmed)} recordings with images ({', '.join(filmed)}): give the option recording")
    chosen = experiment[recording or filmed[0]]
    if chosen.video is None:
        raise UserError(f"recording {chosen.name} of {path} has no images: it lacks transforms.json")
    name = f"{experiment.name}-{chosen.name}"
    return replace(chosen.video, name=name, format="experiment", body=chosen.body, gaussians=chosen.gaussians)
