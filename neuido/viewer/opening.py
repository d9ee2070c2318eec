"""Open a page for whatever there is to look at: a path, frames, Gaussians, or a scene to run live."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuido.errors import UserError
from neuido.types import Gaussians, Scene
from neuido.viewer.content import Content, content_of_frames
from neuido.viewer.sources import is_scene, read_content
from neuido.viewer.world import HOST, PORT

if TYPE_CHECKING:
    from neuido.viewer.live.live_page import LivePage
    from neuido.viewer.playback import Playback

WEIGHTS = "pretrained"
"""Operator of latents where none is named."""


def view(
    thing: Any,
    law: Any = None,
    *,
    scene: Scene | None = None,
    recording: str | None = None,
    colour: str | None = None,
    host: str = HOST,
    port: int = PORT,
) -> "Playback | LivePage":
    """Open a page in the browser for a motion or a scene, and return at once; `wait()` of the result serves until Ctrl+C.

    Args:
        thing: `Frames`, `Gaussians`, a path of what `neuido view` opens, or a `Simulator` or a scene file to run live.
        law: Elastic law, or an elastic and a plastic one: of frames for the stress, of a simulator to run with.
        scene: The scene of frames, for floor, gravity and domain.
        recording: Name of the recording to show, where a path has several.
        colour: Quantity by which particles are coloured at first.
        host: Address that the page listens at.
        port: Port; another one is taken where it is in use.

    Returns:
        The page, with `url`, `wait()` and `stop()`.

    Raises:
        UserError: Nothing to show, a missing extra, an unknown quantity.
    """
    if isinstance(thing, str | os.PathLike):
        if is_scene(thing):
            return _live_of_file(Path(thing), law=law, colour=colour, host=host, port=port)
        return _played(read_content(thing, recording), colour, host, port)
    if isinstance(thing, Gaussians):
        return _played(Content("Gaussians", gaussians=[thing]), colour, host, port)
    if hasattr(thing, "rollout"):
        from neuido.viewer.live.live_run import LawFamily

        laws = tuple(law) if isinstance(law, Sequence) else (law, None)
        return _live(thing, LawFamily(lambda values: laws, ()), "scene", colour, host, port)  # type: ignore[arg-type, return-value]
    if getattr(thing, "x", None) is None or thing.x.ndim != 3:
        raise UserError(f"{type(thing).__name__} cannot be viewed: give Frames, Gaussians, a Simulator or a path")
    elastic = law[0] if isinstance(law, Sequence) else law
    return _played(content_of_frames(thing, scene=scene, law=elastic), colour, host, port)


def open_path(
    path: str,
    *,
    recording: str | None = None,
    colour: str | None = None,
    law: str | None = None,
    latents: Sequence[str] | None = None,
    operator: str | None = None,
    data_root: str | None = None,
    host: str = HOST,
    port: int = PORT,
) -> "Playback | LivePage":
    """Open the page of a path, with the options of `neuido view`."""
    if not is_scene(path):
        return _played(read_content(path, recording), colour, host, port)
    loaded = None
    if law is not None:
        from neuido.models.inference.law_file import load_law

        loaded = load_law(law)
    return _live_of_file(
        Path(path), law=loaded, latents=latents, operator=operator, data_root=data_root, colour=colour, host=host, port=port
    )


def check_scene_options(path: str, options: Mapping[str, Any]) -> None:
    """Refuse options of a live scene where a path is none, or that exclude each other."""
    given = [name for name, value in options.items() if value is not None]
    if given and not is_scene(path):
        raise UserError(f"{given[0]} belongs to a scene file, and {path} is none: leave it out")
    if options["law"] is not None and options["latents"] is not None:
        raise UserError("law and latents are two ways to give a law: leave one out")
    if options["latents"] is not None and len(options["latents"]) != 2:
        raise UserError(f"latents = {options['latents']} must be two names, such as [a, b]")
    if options["operator"] is not None and options["latents"] is None:
        raise UserError("operator belongs to latents: give them, or leave it out")


def _played(content: Content, colour: str | None, host: str, port: int) -> "Playback":
    from neuido.viewer.playback import Playback

    _check_colour(colour, content.quantities())
    return Playback(content, colour=colour, host=host, port=port)


def _check_colour(colour: str | None, names: Sequence[str]) -> None:
    from neuido.errors import suggest

    if colour is not None and colour not in names:
        raise UserError(f"colour = {colour!r} is not known here{suggest(colour, names) or ';'} it is one of {', '.join(names)}")


def _live_of_file(
    path: Path,
    *,
    law: Any = None,
    latents: Sequence[str] | None = None,
    operator: str | None = None,
    data_root: str | None = None,
    colour: str | None = None,
    host: str = HOST,
    port: int = PORT,
) -> "LivePage":
    from neuido.data.bodies.scene_files import load_scene
    from neuido.physics.mpm.simulator import Simulator
    from neuido.viewer.live.live_run import LawFamily, classical_family, latent_family

    setup = load_scene(path, data_root)
    if latents is not None:
        from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator

        made = IntrinsicDynamicsOperator.from_pretrained(operator or WEIGHTS)
        family = latent_family(made, *(made.latent(name) for name in latents))
    elif law is not None:
        laws = tuple(law) if isinstance(law, Sequence) else (law, None)
        family = LawFamily(lambda values: laws, ())  # type: ignore[arg-type, return-value]
    elif setup.body is not None:
        family = classical_family(setup.info["elasticity"], setup.info["plasticity"], setup.info["effects"])
    else:
        family = LawFamily(lambda values: simulator.own_laws, ())
    simulator = Simulator(setup.scene, setup.body, density=setup.info.get("density", 1000.0))
    return _live(simulator, family, setup.info["name"], colour, host, port)


def _live(simulator: Any, family: Any, title: str, colour: str | None, host: str, port: int) -> "LivePage":
    from neuido.viewer.live.live_page import LivePage
    from neuido.viewer.live.live_run import LiveRun

    return LivePage(LiveRun(simulator, family), title, colour=colour, host=host, port=port)
