"""The page of a scene that is simulated while one looks at it."""

import time
from typing import Any

import numpy as np

from neuido.data.files.html_page import escaped
from neuido.physics.colliders.solid_meshes import mesh_of
from neuido.viewer.content import PLAIN, Content, Motion, with_scene
from neuido.viewer.live.live_run import LiveRun, Parameter
from neuido.viewer.picture import COLLIDER
from neuido.viewer.playback import speed_factor
from neuido.viewer.quantities import Quantity, TotalGradients, quantities_of, readable, stress_by_body, stress_of
from neuido.viewer.world import HOST, PORT, Cloud, address_of, close_server, furnish, legend_html, open_server

HULL_SECONDS = 0.25
"""Time between two updates of the hull at which the mouse takes hold of a body [s]."""
HULL_POINTS = 4000
"""Particles, evenly chosen, of which the hull is made."""
MOST_GRAVITY = 20.0
"""Largest component of gravity on a slider [m/s^2]."""
SPEEDS = ("1/10", "1/4", "1/2", "1")
FREQUENCIES = (0.5, 15.0)
"""Range of the frequency of the spring that pulls [Hz]."""


class LivePage:
    """A page that runs a scene.

    Args:
        run: The simulation.
        title: Name of the scene.
        colour: Name of the quantity by which particles are coloured at first.
        host: Address that the server listens at.
        port: Port; another one is taken where it is in use.

    Attributes:
        server: The viser server.
        run: The simulation.
    """

    def __init__(self, run: LiveRun, title: str, *, colour: str | None = None, host: str = HOST, port: int = PORT) -> None:
        self.run, self.title, self.pictures = run, title, 0
        self._first = [part.detach().cpu().numpy() for part in (run.state.x, run.state.v, run.state.F)]
        self._total = TotalGradients(self._first[0], self._first[2])
        many = len(run.scene.bodies) > 1
        self._body = np.repeat(np.arange(len(run.scene.bodies)), [len(each.x) for each in run.scene.bodies]) if many else None
        self._ranges: dict[str, tuple[float, float]] = {}
        self._colour, self._hull_time = colour or "speed", 0.0
        self.server = open_server("neuido", host, port)
        motion = Motion(title, np.zeros(1), self._first[0][None], body=self._body)
        self.content = with_scene(Content(title, [motion]), run.scene)
        low, high = self.content.bounds
        down = self.content.up * np.dot(high - low, np.abs(self.content.up))
        self.content.__dict__["bounds"] = np.minimum(low, low - down).clip(run.scene.lower), high  # room to fall
        self._groups = furnish(self.server, self.content)
        self.cloud = Cloud(self.server, "particles", motion.spacing or 0.02 * self.content.size)
        self._hull: Any = None
        self._line: Any = None
        self._colliders = [self._add_collider(i) for i in range(len(run.colliders.shapes))]
        self._add_controls()
        self.show()
        run.shown = self.show
        run.start()

    @property
    def url(self) -> str:
        """Address of the page."""
        return address_of(self.server)

    def _add_controls(self) -> None:
        gui, run = self.server.gui, self.run
        gui.add_markdown(f"**{escaped(self.title)}** live")
        self.play = gui.add_checkbox("play", False)
        self.play.on_update(lambda event: self._played(event))
        self.step, self.reset = gui.add_button("step"), gui.add_button("reset")
        self.step.on_click(lambda event: run.step())
        self.reset.on_click(lambda event: self._restart())
        self.time = gui.add_text("time", "0 s", disabled=True)
        self.error = gui.add_html("", visible=False)
        self.speed = gui.add_dropdown("speed", SPEEDS, initial_value="1")
        self.speed.on_update(lambda event: setattr(run, "speed", speed_factor(str(self.speed.value))))
        names = [*self._quantities(), PLAIN]
        self._colour = self._colour if self._colour in names else names[0]
        self.colour = gui.add_dropdown("colour", names, initial_value=self._colour)
        self.colour.on_update(lambda event: self._recolour(str(self.colour.value)))
        self.legend = gui.add_html("")
        with gui.add_folder("law"):
            self.sliders = {each.name: self._slider(each) for each in run.family.parameters}
            if not self.sliders:
                gui.add_markdown("This law has no parameters to change.")
        with gui.add_folder("gravity [m/s²]"):
            self.gravity = [self._pull_of(axis) for axis in range(3)]
        for i in run.colliders.movable():
            with gui.add_folder(_name(run.colliders.shapes[i], i), expand_by_default=False):
                self._add_place(i)
        with gui.add_folder("pull"):
            gui.add_markdown("Drag the body with the left mouse button.")
            self.frequency = gui.add_slider("spring [Hz]", *FREQUENCIES, 0.5, run.frequency)
            self.frequency.on_update(lambda event: setattr(run, "frequency", float(self.frequency.value)))
            self.force = gui.add_text("force", "0 N", disabled=True)
        with gui.add_folder("shown", expand_by_default=False):
            self.size = gui.add_slider("point size", 0.2, 3.0, 0.1, 1.0)
            self.size.on_update(lambda event: self._resize(float(self.size.value)))
            for name, handles in self._groups.items():
                self._switch(name, handles)

    def _switch(self, name: str, handles: list[Any]) -> None:
        box = self.server.gui.add_checkbox(name, True)
        box.on_update(lambda event: [setattr(handle, "visible", bool(box.value)) for handle in handles])

    def _slider(self, parameter: Parameter) -> Any:
        """Add a slider for a parameter of the law; that of a stiffness moves the logarithm, and shows its value beside."""
        gui, name = self.server.gui, parameter.name
        if not parameter.logarithmic:
            label = f"{name} [{parameter.unit}]" if parameter.unit else name
            made = gui.add_slider(label, parameter.low, parameter.high, 0.01 * (parameter.high - parameter.low), parameter.value)
            made.on_update(lambda event: self.run.change(name, float(made.value)))
            return made
        low, high, now = (round(float(np.log10(value)), 2) for value in (parameter.low, parameter.high, parameter.value))
        shown = gui.add_text(name, _words(parameter.value, parameter.unit), disabled=True)
        made = gui.add_slider(f"lg {name}", low, high, 0.01, now)

        def changed(event: Any) -> None:
            shown.value = _words(10.0 ** float(made.value), parameter.unit)
            self.run.change(name, 10.0 ** float(made.value))

        made.on_update(changed)
        return made

    def _pull_of(self, axis: int) -> Any:
        most = max(MOST_GRAVITY, abs(self.run.gravity[axis]))
        made = self.server.gui.add_slider("xyz"[axis], -most, most, 0.1, self.run.gravity[axis])

        def changed(event: Any) -> None:
            self.run.gravity = tuple(float(made.value) if a == axis else g for a, g in enumerate(self.run.gravity))

        made.on_update(changed)
        return made

    def _add_collider(self, index: int) -> Any:
        """Add the surface of a collider; None of a half-space, which has none."""
        mesh = mesh_of(self.run.colliders.shapes[index])
        if mesh is None:
            return None
        points, faces = mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32)
        return self.server.scene.add_mesh_simple(f"/collider/{index}", points, faces, color=COLLIDER, flat_shading=True, side="double")

    def _add_place(self, index: int) -> None:
        """Add sliders for the position of a collider."""
        run, made = self.run, []
        for axis in range(3):
            low, high = run.scene.lower[axis], run.scene.upper[axis]
            now = float(np.clip(run.colliders.poses[index, axis], low, high))
            made.append(self.server.gui.add_slider(f"{'xyz'[axis]} [m]", low, high, (high - low) / 200, now))
        for slider in made:
            slider.on_update(lambda event: run.move_collider(index, np.array([float(each.value) for each in made])))

    def _played(self, event: Any) -> None:
        if event.client_id is not None:
            self.run.play(bool(self.play.value))

    def _restart(self) -> None:
        self._ranges = {}
        self.run.reset()

    def _recolour(self, name: str) -> None:
        self._colour = name
        self.show()

    def _resize(self, scale: float) -> None:
        self.cloud.scale = scale
        self.cloud.handle.point_size = self.cloud.size()

    def _quantities(self) -> dict[str, Quantity]:
        """Return the quantities of the state now, which is the second of two frames; the first is that at t = 0."""
        now = [part.detach().cpu().numpy() for part in (self.run.state.x, self.run.state.v, self.run.state.F)]
        x, v, F = (np.stack(pair) for pair in zip(self._first, now))
        law, bodies = self.run.laws[0], self.run.scene.bodies
        stress = None if law is None else stress_of(law)
        if law is None and self._body is not None:
            stress = stress_by_body([each.law for each in bodies], self._body)
        return quantities_of(np.array([0.0, max(self.run.time, 1e-9)]), x, v, F, stress=stress, gradients=self._total)

    def show(self) -> None:
        """Draw the state now."""
        run, self.pictures = self.run, self.pictures + 1
        found = self._quantities().get(self._colour)
        x = run.state.x.detach().cpu().numpy()
        if found is None:
            colours = self.content.motions[0].colours(0, PLAIN)
        else:
            low, high = found.range
            known = self._ranges.get(self._colour, (low, high))
            found.range = self._ranges[self._colour] = min(low, known[0]), max(high, known[1])
            colours = found.colours(1)
        with self.server.atomic():
            self.cloud.show(x, self.content.motions[0].lit(x, colours))
            self._show_pull()
            for handle, pose in zip(self._colliders, run.colliders.poses):
                if handle is not None:
                    handle.position, handle.wxyz = tuple(pose[:3]), tuple(pose[3:])
            self.legend.content = legend_html(found)
            self.time.value = f"{run.time:.3f} s" + (f", at {run.pace:.2g} of real time" if run.playing else "")
            self.force.value = f"{float(np.linalg.norm(run.force)):.3g} N"
            self.error.visible = bool(run.error)
            self.error.content = f"<div class='neuido-error' style='padding:0 1em;color:#b3261e'>{escaped(run.error)}</div>"
            if self.play.value != run.playing:
                self.play.value = run.playing
        if run.held() is None and time.monotonic() - self._hull_time > HULL_SECONDS:
            self._show_hull(x)
        self.server.flush()

    def _show_pull(self) -> None:
        held = self.run.held()
        ends = np.zeros((1, 2, 3), np.float32) if held is None else np.stack(held)[None].astype(np.float32)
        if self._line is None:
            self._line = self.server.scene.add_line_segments("/pull", ends, (205, 55, 40), thickness=3.0, thickness_units="screen")
        self._line.points, self._line.visible = ends, held is not None

    def _show_hull(self, x: np.ndarray) -> None:
        """Put a transparent hull around the body, which the mouse takes hold of: points cannot be clicked."""
        import trimesh

        self._hull_time = time.monotonic()
        points = x[np.isfinite(x).all(axis=1)][:: max(1, len(x) // HULL_POINTS)]
        try:
            hull = trimesh.convex.convex_hull(points)
        except Exception:  # flat or empty: Qhull raises errors of its own
            return
        vertices, faces = np.asarray(hull.vertices, np.float32), np.asarray(hull.faces, np.uint32)
        if self._hull is None:
            self._hull = self.server.scene.add_mesh_simple(
                "/hull", vertices, faces, opacity=0.0, side="double", cast_shadow=False, receive_shadow=False
            )
            self._hull.on_drag("left")(self._dragged)
        else:
            with self.server.atomic():
                self._hull.vertices, self._hull.faces = vertices, faces

    async def _dragged(self, event: Any) -> None:
        """Follow the mouse; asynchronous, since viser calls these in order."""
        if event.phase == "start":
            self.run.grip(np.array(event.start_position))
        if event.phase == "end":
            self.run.release()
        else:
            self.run.drag(np.array(event.end_position))

    def wait(self) -> None:
        """Serve until `stop` is called or the process is interrupted."""
        self.run._ended.wait()

    def stop(self) -> None:
        """End the simulation and the server."""
        self.run.stop()
        close_server(self.server)


def _name(shape: Any, index: int) -> str:
    return getattr(shape, "name", "") or f"{type(shape).__name__.lower()} {index}"


def _words(value: float, unit: str) -> str:
    factor, told = readable(value, unit)
    return f"{factor * value:.3g} {told}"
