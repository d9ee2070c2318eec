"""The `simulate` command: Stage I trajectories, or filmed scenes where the configuration names some. `--help` loads no torch."""

import inspect
from pathlib import Path
from typing import Any

from neuido.data.files.writing import check_writable
from neuido.data.scenes.film_options import Film
from neuido.data.trajectories.options import simulate as trajectories
from neuido.data.undeclared import Case, make_undeclared
from neuido.errors import UserError


def simulate(
    out: str,
    *,
    scenes: list[dict[str, Any]] | None = None,
    film: Film = Film(),  # noqa: B008 (frozen)
    experiment: str | None = None,
    model: str | None = None,
    undeclared: int | None = None,
    case: Case = Case(),  # noqa: B008 (frozen)
    data_root: str | None = None,
    device: str = "auto",
    progress: bool = True,
    **options: Any,
) -> None:
    """Simulate the constitutive trajectories of Stage I, or, where `scenes` are given, scenes with images from several views.

    `neuido simulate SCENE --out FOLDER` runs one scene file; `neuido simulate SCENE --help` lists its options.

    Trajectories: a spinning cube is thrown into a box, for many materials; the set-up is NCLaw's, and its three published materials
    are instance 0 of their families. Scenes: one experiment folder each, with images, cameras and the truth
    (configs/scenes/six.yaml); of the options below only film, data_root, device and progress are for them. A run that was interrupted
    goes on where it stopped when the same command is given again. On the CPU the files are equal byte for byte. With `undeclared`: one
    folder to diagnose, and its key in ../keys. With `experiment`: its recordings under a model, as another experiment.

    Args:
        out: Folder to write: one file per trajectory, or one folder per scene.
        scenes: Scenes to make in place of trajectories; each has `name`, the keys of a scene file (or `base`, the name of
            one, with keys that differ), and any of `velocity`, `angular_velocity`, `shift`, `declared`, `split`, `substeps`.
        film: How they are filmed.
        experiment: Folder of an experiment whose recordings are to be simulated under its model.
        model: File with a model in place of the experiment's own, for example the model_after.yaml of `neuido diagnose`.
        undeclared: Seed of a case with an effect that its model does not declare, or with none; `out` is its folder.
        case: What of that case is not to be drawn from the seed.
        data_root: Folder of the particles that scenes name; that of NEUIDO_DATA where absent.
        device: auto, cpu or cuda.
        progress: Show a progress bar.
        options: Of the trajectories.

    Raises:
        UserError: An impossible material or option, a step above the stability limit, a folder that holds another set-up.
    """
    check_writable(Path(out))
    if model is not None and experiment is None:
        raise UserError(f"model = {model} is for the recordings of an experiment: give experiment too")
    if experiment is not None:
        if scenes is not None or undeclared is not None:
            raise UserError(f"experiment and {'scenes' if scenes is not None else 'undeclared'} are both given: leave one of the two out")
        from neuido.discrepancy.replay import replay

        replay(experiment, out, model=model, device=device, progress=progress)
        return
    if undeclared is not None:
        if scenes is not None:
            raise UserError("undeclared and scenes are both given: leave one of the two out")
        make_undeclared(undeclared, out, case=case, device=device, progress=progress)
        return
    if scenes is None:
        trajectories(out, device=device, progress=progress, **options)
        return
    known = inspect.signature(trajectories).parameters
    for name, value in options.items():
        if value != known[name].default:
            raise UserError(f"{name} = {value} is an option of trajectories, and scenes are given: leave one of the two out")
    from neuido.data.scenes.synthetic import make_scenes
    from neuido.models.render.splatting import rasterize

    make_scenes(scenes, film, out, draw=rasterize, data_root=data_root, device=device, progress=progress)
