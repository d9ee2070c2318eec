"""The `replay` command: the recordings of an experiment as a model predicts them. `--help` loads no torch."""

from pathlib import Path

from neuido.data.files.writing import check_writable


def replay(folder: str, *, out: str, model: str | None = None, device: str = "auto", progress: bool = True) -> None:
    """Simulate the recordings of an experiment under a model, and write them as another experiment, without noise.

    The tracked points are those of the experiment; of a video, whose points nobody tracked, they are all particles.

    Args:
        folder: Folder of the experiment.
        out: Folder to write, new or empty; it appears when it is whole.
        model: File with a model in place of the experiment's own, for example the model_after.yaml of `neuido diagnose`.
        device: auto, cpu or cuda.
        progress: Show a progress bar.

    Raises:
        UserError: No experiment, a model that cannot run, a folder that is in use.
    """
    check_writable(Path(out))
    from neuido.discrepancy.applied_model import replay

    apart, doubtful = replay(folder, out, model=model, device=device, progress=progress)
    for name, distance in apart.items():
        print(f"{name}: {'no points were tracked' if distance is None else f'{1e3 * distance:.3g} mm RMS from the measured points'}")
    for name, events in doubtful.items():
        for event in events:
            print(f"note: {name}: {event.words}")
    print(f"results in {out}: `neuido diagnose {out} --out FOLDER` reads it")
