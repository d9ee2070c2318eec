"""A filmed body as a `Problem`: silhouettes instead of tracked points, predicted by simulation and rendering.

The data of an image are moments of the silhouette and the place of its outline along the normals of the measured outline
(`silhouettes.features`), in recorded pixels. The first frame is not fitted. Its body is known, so that it calibrates cameras and outline,
and its residual is the noise of the later frames.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from neuido.data.cameras import project
from neuido.data.measured.experiment import Experiment
from neuido.data.measured.experiment import Recording as Measured
from neuido.discrepancy.problems import silhouettes
from neuido.discrepancy.problems.body import INSTRUMENTS, WINDOWS, BodyProblem, Run, body_problem
from neuido.discrepancy.problems.filmed import Film, Look, Splats, body_of, looks, read_film
from neuido.discrepancy.problems.problem import Parameter, Point, Recording
from neuido.discrepancy.problems.rollouts import Motions
from neuido.discrepancy.problems.silhouettes import Outlines, Score, View, outlines
from neuido.errors import UserError
from neuido.types import Cameras, ParticleState

CAMERA = (  # errors of a camera: name, unit, prior standard deviation in that unit (px: of the recording)
    ("x", "px", 0.5),
    ("y", "px", 0.5),
    ("scale", "1", 0.003),
    ("roll", "rad", 0.003),
    ("outline", "px", 0.3),
)
LOOSE = 8.0
"""Factor on the priors of `CAMERA` in the calibration by the first frame."""
UNSEEN = 6.0
"""Factor on the priors of velocity and spin where they were estimated from the images."""
FAINT = 0.15
"""Least noise of an outline [px of the compared silhouettes]."""
LEAST_OVERLAP = 0.4
"""Least overlap of drawn and measured silhouette in the first frame (area of the intersection over that of the union)."""
ONE_VIEW = "One view tells nothing of the line of sight: the depth of the body is as given, and motion and forces along it are not seen."
"""What an answer from one camera cannot tell."""
TRACKED = 60
"""Number of particles that represent the body where points are needed: for typical speeds, and to propose the next experiment."""


class Footage(NamedTuple):
    """Silhouettes of a recording, prepared for comparison."""

    film: Film
    look: "Look | Splats"
    """Gaussians by which the body is drawn."""
    cameras: Cameras
    """Cameras of the silhouettes, on the device."""
    at: Outlines
    """Measured outlines of the R images that are compared (frames after the first)."""
    images: Tensor
    """Frame and view of each compared image, (R, 2)."""
    first: Outlines
    """Measured outlines of the first frame."""
    first_views: list[int]
    """Views whose first frame shows the body."""
    millimetres: float
    """Size of a recorded pixel at the body [mm]."""
    inset: float = 0.0
    """Distance of the measured outline inside the drawn one in the first frame [px]."""


@dataclass(frozen=True, eq=False)
class VideoProblem(BodyProblem):
    """An experiment whose recordings are videos without tracked points."""

    tracked: bool = False
    footage: tuple[Footage, ...] = ()

    def error(self, residual: np.ndarray, recording: int) -> float:
        return float(np.sqrt(np.mean(residual**2)))

    def directions(self, recording: int) -> np.ndarray:
        """Return affine motions of the image of each view in windows of time, (n, k): patterns of an unknown discretisation error."""
        f = self.footage[recording]
        measured = torch.from_numpy(f.film.masks).to(f.at.points.device)[f.images[:, 0], f.images[:, 1]]
        columns = silhouettes.displaced(f.at, measured).cpu().numpy()
        t = f.film.times.numpy()
        knots = np.linspace(t[1], t[-1], WINDOWS)
        frame, view = f.images.cpu().numpy().T
        bumps = np.maximum(0.0, 1.0 - np.abs(t[frame][:, None] - knots) / (knots[1] - knots[0]))
        own = view[:, None] == np.arange(len(f.film.views))
        rows = np.einsum("rt,rv,rmk->rmtvk", bumps, own, columns)[f.at.kept.cpu().numpy()]
        rows = rows.reshape(len(rows), -1)
        return rows / np.sqrt(np.mean(np.sum(rows**2, axis=1)))

    def _scored(self, point: Point, recording: int, setting: int = 0) -> tuple[np.ndarray, dict[str, Score]]:
        """Draw the predicted silhouettes (T, V, H, W), and score the fitted frames (`fit`) and the others (`held_out`)."""
        f = self.footage[recording]
        drawn = self._drawn(_motion_of(self._moved(point, recording, setting), 0), recording, point)
        frames = self.fitted_frames(recording)
        scores = {}
        for name, chosen in (("fit", frames), ("held_out", ~frames)):
            chosen = chosen & (np.arange(len(frames)) > 0)
            if chosen.any():
                flat = (a[chosen].reshape(-1, *a.shape[2:]) for a in (drawn, f.film.masks))
                score = silhouettes.score(*flat, f.inset)
                scores[name] = score._replace(outline=score.outline * f.film.factor)
        return drawn, scores

    def silhouettes(self, d: Any) -> dict[str, dict[str, Any]]:
        """Return the silhouettes of each recording for the report.

        Args:
            d: Diagnosis with the parameter sets `before` and `after`, and the setting.

        Returns:
            For each recording `masks`, `drawn_before` and `drawn_after` (T, V, H, W), `times` (T,) [s], `inset` [px], and the `scores`
            before and after by role.
        """
        out = {}
        for n, r in enumerate(self.recordings):
            f = self.footage[n]
            own: dict[str, Any] = {"masks": f.film.masks, "inset": f.inset, "times": f.film.times.numpy(), "scores": {}}
            for when, point in (("before", d.before), ("after", d.after)):
                own[f"drawn_{when}"], scores = self._scored(point, n, d.setting)
                own["scores"][when] = {
                    role: {"iou": s.iou, "outline_px": s.outline, "outline_mm": s.outline * f.millimetres, "psnr": s.psnr}
                    for role, s in scores.items()
                }
            out[r.name] = own
        return out

    def fitted_frames(self, recording: int) -> np.ndarray:
        """Return the mask (T,) of fitted frames.

        It is all or none of a recording by its role. Without held-out recordings it is the first 60 % of the time, as in `floors.split`.
        """
        t = self.footage[recording].film.times.numpy()
        if self.roles["held_out"]:
            return np.full(len(t), self.recordings[recording].role == "fit")
        return t <= t[1] + 0.6 * (t[-1] - t[1])

    def simulated(self, recording: int) -> Measured:
        """Return the recording with all particles as tracked points, as the declared model moves them."""
        r = self.measured[recording]
        x = self._moved({}, recording).x[:, 0].cpu().float()
        return replace(r, x=x, track=torch.arange(x.shape[1]), noise=None, video=None, gaussians=None)

    def as_tracked(self) -> BodyProblem:
        """Return the same experiment as if some particles had been tracked, with the noise of the outlines as distance at the body."""
        recordings = []
        for r, own, f in zip(self.measured, self.recordings, self.footage, strict=True):
            y = r.x.double().numpy()[1:].reshape(-1)
            groups = np.tile(np.arange(r.x.shape[1] * 3), len(r.t) - 1)
            times = np.repeat(r.t.numpy()[1:], r.x.shape[1] * 3)
            recordings.append(Recording(r.name, r.role, y, 1e-3 * f.millimetres * (own.noise or 1.0), groups, times))
        return BodyProblem(
            name=self.name, measure="rmse", unit="m", declared=self.declared, nuisances=(), candidates=self.candidates,
            recordings=tuple(recordings), settings=self.settings, solvers=self.solvers, experiment=self.experiment,
            measured=self.measured, device=self.device, batch=self.batch,
        )  # fmt: skip

    # Forward runs.

    def _simulate(self, runs: Sequence[Motions], setting: int) -> Sequence[Any]:
        return self._move(runs, setting)

    def _fill(self, run: Run, moved: Any) -> None:
        f = self.footage[run.recording]
        for s, group in enumerate(run.groups):
            motion = _motion_of(moved, s)
            if not bool(torch.isfinite(motion.x[-1]).all()):
                run.out[group] = np.nan
                continue
            drawn: dict[tuple[float, float], Tensor] = {}
            for i in group:
                clock = self._clock(run.points[i], run.recording)
                if clock not in drawn:
                    drawn[clock] = f.look.draw(self._shifted(motion, clock, run.recording), f.cameras)
                run.out[i] = self._seen(drawn[clock], run.points[i], run.recording)

    def _clock(self, point: Point, recording: int) -> tuple[float, float]:
        name = self.measured[recording].name
        return point.get(f"release_time:{name}", 0.0), point.get(f"time_base:{name}", 0.0)

    def _shifted(self, motion: ParticleState, clock: tuple[float, float], recording: int) -> ParticleState:
        """Return a motion at times shifted by the errors of the clock (release time [s], relative time base), to first order."""
        if not any(clock):
            return motion
        t = self.measured[recording].t.to(motion.x)[:, None, None]
        return motion._replace(x=motion.x + (clock[0] + clock[1] * t) * motion.v)

    def _seen(self, drawn: Tensor, point: Point, recording: int) -> np.ndarray:
        """Return the data (n,) of drawn silhouettes (T, V, H, W) [recorded px], with the errors of the cameras."""
        f = self.footage[recording]
        rows = torch.empty(f.at.kept.shape, dtype=drawn.dtype, device=drawn.device)
        for v in range(len(f.film.views)):
            own = f.images[:, 1] == v
            at = Outlines(*(t[own] for t in f.at))
            rows[own] = silhouettes.features(drawn[f.images[own, 0], v], at, self._view(point, recording, v))
        return f.film.factor * rows[f.at.kept].double().cpu().numpy()

    def _view(self, point: Point, recording: int, view: int) -> View:
        """Return the errors of a camera in a parameter set, in pixels of the silhouettes."""
        name, factor = self.measured[recording].name, self.footage[recording].film.factor
        given = {}
        for key, unit, _ in CAMERA:
            p = f"camera_{key}{view}:{name}"
            value = point.get(p, self._values.get(p, 0.0))
            given[key] = value / factor if unit == "px" else value
        return View(**given)

    @property
    def _values(self) -> dict[str, float]:
        return {p.name: p.value for p in self.nuisances}

    def _drawn(self, motion: ParticleState, recording: int, point: Point) -> np.ndarray:
        """Draw silhouettes as the cameras with their errors see them, (T, V, H, W)."""
        f = self.footage[recording]
        drawn = f.look.draw(motion, f.cameras)
        out = [_warped(drawn[:, v], self._view(point, recording, v)) for v in range(drawn.shape[1])]
        return torch.stack(out, 1).cpu().numpy()


def _motion_of(frames: ParticleState, s: int) -> ParticleState:
    """Return the frames (T, P, ...) of the parameter set s from those of several."""
    return ParticleState(*(t[:, s].contiguous() for t in frames))


def _warped(masks: Tensor, view: View) -> Tensor:
    """Warp masks (T, H, W) by the errors of a camera."""
    height, width = masks.shape[-2:]
    y, x = torch.meshgrid(*(torch.arange(n, dtype=masks.dtype, device=masks.device) + 0.5 for n in (height, width)), indexing="ij")
    middle, shift = masks.new_tensor([0.5 * width, 0.5 * height]), masks.new_tensor([view.x, view.y])
    turn = masks.new_tensor([[np.cos(view.roll), -np.sin(view.roll)], [np.sin(view.roll), np.cos(view.roll)]]) * (1 + view.scale)
    place = (torch.stack([x, y], -1) - middle - shift) @ torch.linalg.inv(turn).T + middle
    grid = 2 * place / place.new_tensor([width, height]) - 1
    return torch.nn.functional.grid_sample(masks[:, None], grid.expand(len(masks), -1, -1, -1), align_corners=False)[:, 0]


def video_problem(experiment: Experiment, *, device: str = "cpu", batch: int = 0) -> VideoProblem:
    """Build the problem of an experiment with videos; tracked points are ignored.

    Args:
        experiment: The experiment.
        device: `cpu` or a CUDA device.
        batch: Number of motions per launch on a GPU; 0: the default of `BodyProblem`.

    Raises:
        UserError: The silhouettes or the body cannot be read (`filmed.read_film`, `filmed.body_of`), no recording is to be fitted, or the
            declared model cannot be simulated.
    """
    films, measured, known = [], [], []
    for r in experiment.recordings:
        films.append(read_film(experiment, r))
        body, launched = body_of(experiment, r)
        known.append(launched)
        still = body.x[None].expand(len(films[-1].times), -1, -1)
        track = torch.arange(len(body.x))
        measured.append(replace(r, x=still, t=films[-1].times, body=body, track=track, anchor=None, noise=None))
    plain = replace(experiment, recordings=tuple(measured))
    base = body_problem(plain, device=device, batch=batch)
    # typical speeds and places are those of some particles in the declared motion
    moved = [_motion_of(base._moved({}, n), 0) for n in range(len(measured))]
    tracked = [_with_tracked_particles(r, m) for r, m in zip(measured, moved, strict=True)]
    base = body_problem(replace(experiment, recordings=tuple(tracked)), device=device, batch=batch)
    footage = [_footage(r, experiment, film, m, device) for r, film, m in zip(tracked, films, moved, strict=True)]
    nuisances = [_widened_launch(p, dict(zip((r.name for r in tracked), known, strict=True))) for p in base.nuisances]
    nuisances = [p for p in nuisances if not p.name.startswith("length_scale:")]
    recordings = []
    for n, r in enumerate(tracked):
        cameras, noise = _calibrate(r, footage[n], moved[n])
        nuisances += cameras
        recordings.append(_recording(r, footage[n], noise))
        footage[n] = footage[n]._replace(inset=_inset(footage[n], moved[n]))
    labels = base.labels | ({"unseen": ONE_VIEW} if any(len(f.film.views) == 1 for f in footage) else {})
    kinds = tuple(f"camera_{key}{v}" for key, _, _ in CAMERA for v in range(max(len(f.film.views) for f in footage)))
    return VideoProblem(
        name=experiment.name, measure="outline", unit="px", declared=base.declared, nuisances=tuple(nuisances),
        candidates=base.candidates, recordings=tuple(recordings), settings=base.settings, solvers=base.solvers,
        labels=labels, experiment=experiment, measured=tuple(tracked), device=device, batch=batch,
        instruments=(*INSTRUMENTS, *kinds), footage=tuple(footage),
    )  # fmt: skip


def _with_tracked_particles(r: Measured, moved: ParticleState) -> Measured:
    """Return the recording with some particles in their declared motion as tracked points."""
    pick = torch.linspace(0, len(r.body.x) - 1, min(TRACKED, len(r.body.x))).round().long()
    return replace(r, x=moved.x[:, pick.to(moved.x.device)].cpu().float(), track=pick)


def _widened_launch(p: Parameter, known: dict[str, bool]) -> Parameter:
    """Widen the prior of a velocity or spin by `UNSEEN` if it was estimated from images; other nuisances stay as they are."""
    kind, _, name = p.name.partition(":")
    if known[name] or not kind.startswith(("velocity", "spin")):
        return p
    return replace(p, scale=UNSEEN * p.scale, lower=UNSEEN * p.lower, upper=UNSEEN * p.upper)


def _footage(r: Measured, experiment: Experiment, film: Film, moved: ParticleState, device: str) -> Footage:
    """Prepare the silhouettes of a recording for comparison.

    Raises:
        UserError: The object is seen in too few frames, or the body lies behind a camera.
    """
    images = [(t, v) for t in range(1, len(film.times)) for v in range(len(film.views)) if silhouettes.usable(film.masks[t, v])]
    if len({t for t, _ in images}) < 3:
        raise UserError(f"recording {r.name}: the object is seen in {len({t for t, _ in images})} frames after the first; 3 are needed")
    first = [v for v in range(len(film.views)) if silhouettes.usable(film.masks[0, v])]
    index = np.array(images)
    at = outlines(film.masks[index[:, 0], index[:, 1]], film.cut[index[:, 1]])
    at, begun = (Outlines(*(t.to(device) for t in o)) for o in (at, outlines(film.masks[0, first], film.cut[first])))
    cameras = film.cameras._replace(viewmats=film.cameras.viewmats.to(device), Ks=film.cameras.Ks.to(device))
    _, depth = project(moved.x[0].float().cpu(), film.cameras.at(0))
    later = range(1, len(film.times)) if film.cameras.moving else ()
    if bool((depth <= 0).any()) or any(bool((project(r.body.x.float(), film.cameras.at(t))[1] <= 0).all()) for t in later):
        raise UserError(f"recording {r.name}: the body lies behind a camera: check transform_matrix, and that positions are in metres")
    scale = float((depth.mean(dim=1) / film.cameras.Ks[:, 0, 0]).mean()) / film.factor
    look = looks(experiment[r.name], experiment, r.body, film, device)
    return Footage(film, look, cameras, at, torch.from_numpy(index).to(device), begun, first, 1e3 * scale)


def _calibrate(r: Measured, f: Footage, moved: ParticleState) -> tuple[list[Parameter], float]:
    """Calibrate cameras and outline by the first frame.

    Returns:
        The errors of the cameras as nuisances around their calibrated values, and the noise [recorded px]: the residual of the first frame.

    Raises:
        UserError: Body and silhouette hardly overlap.
    """
    drawn = f.look.draw(ParticleState(*(t[:1] for t in moved)), f.cameras)[0]
    factor, out, left, overlap = f.film.factor, [], [], 1.0
    for v in range(len(f.film.views)):
        given = [0.0] * len(CAMERA)
        if v in f.first_views:
            i = f.first_views.index(v)
            at = Outlines(*(t[i : i + 1] for t in f.first))
            measured = torch.from_numpy(f.film.masks[:1, v]).to(drawn.device)
            target = silhouettes.features(measured, at)
            given, rest = _fit_view(drawn[v][None], at, target, factor)
            left.append(rest)
            overlap = min(overlap, silhouettes.score(drawn[v][None].cpu().numpy(), f.film.masks[:1, v]).iou)
        for (key, unit, deviation), value in zip(CAMERA, given, strict=True):
            name, far = f"camera_{key}{v}:{r.name}", 8 * deviation
            out.append(Parameter(name, unit, value, deviation, value - far, value + far, prior=1.0))
    rest = np.concatenate(left)
    if overlap < LEAST_OVERLAP or not np.isfinite(rest).all():
        raise UserError(
            f"recording {r.name}: body and silhouette of the first frame have an overlap of {overlap:.2f}, below {LEAST_OVERLAP}: check "
            "transform_matrix, intrinsics and x0"
        )
    return out, factor * float(np.hypot(FAINT, np.sqrt(np.mean(rest**2))))


def _fit_view(drawn: Tensor, at: Outlines, target: Tensor, factor: float, steps: int = 6) -> tuple[list[float], np.ndarray]:
    """Fit the errors of a camera so that a drawn silhouette matches the measured one, by Gauss-Newton steps with wide priors.

    Returns:
        The errors in the order of `CAMERA` (lengths in recorded px), and the residual [px of the silhouettes].
    """
    spread = LOOSE * np.array([d / factor if unit == "px" else d for _, unit, d in CAMERA])
    kept = at.kept[0].cpu().numpy()
    values = np.zeros(len(CAMERA))

    def residual(given: np.ndarray) -> np.ndarray:
        return (silhouettes.features(drawn, at, View(*given)) - target)[0].double().cpu().numpy()[kept]

    for _ in range(steps):
        r = residual(values)
        J = np.stack([(residual(values + h) - r) / 0.1 for h in 0.1 * np.diag(spread)], axis=1)
        A = np.concatenate([J, 0.5 * np.eye(len(values))])  # the priors, for residuals of about half a pixel
        values = values - spread * np.linalg.lstsq(A, np.concatenate([r, 0.5 * values / spread]), rcond=None)[0]
    given = [v * factor if unit == "px" else v for v, (_, unit, _) in zip(values, CAMERA, strict=True)]
    return [float(v) for v in given], residual(values)


def _inset(f: Footage, moved: ParticleState) -> float:
    """Return the distance of the measured outline inside the drawn one in the first frame [px]."""
    drawn = f.look.draw(ParticleState(*(t[:1] for t in moved)), f.cameras)[0].cpu().numpy()
    return silhouettes.inset(drawn[f.first_views], f.film.masks[0, f.first_views])


def _recording(r: Measured, f: Footage, noise: float) -> Recording:
    """Return the measured features of the silhouettes as data [recorded px], with their noise."""
    kept = f.at.kept.cpu().numpy()
    frame, view = f.images.cpu().numpy().T
    measured = torch.from_numpy(f.film.masks[frame, view]).to(f.at.points.device)
    y = f.film.factor * silhouettes.features(measured, f.at).double().cpu().numpy()
    rows = np.arange(kept.shape[1])
    groups = view[:, None] * kept.shape[1] + rows
    times = np.repeat(f.film.times.numpy()[frame][:, None], kept.shape[1], axis=1)
    return Recording(r.name, r.role, y[kept], noise, groups[kept], times[kept])
