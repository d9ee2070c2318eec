"""The demonstration's reading: a duck of soft rubber in a film, its law in one pass with an interval, and both motions side by side."""

import math
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    import numpy as np
    from torch import Tensor

    from neuido.types import Body

TRUE_YOUNG, POISSON = 6e4, 0.3
"""The material of the duck, which is not told to the encoder."""
ELLIPSOIDS = (
    ((0.0, 0.0, 0.0), (0.17, 0.115, 0.125), (0.98, 0.80, 0.12)),  # body
    ((0.10, 0.145, 0.0), (0.088, 0.085, 0.083), (0.98, 0.82, 0.16)),  # head
    ((0.195, 0.135, 0.0), (0.05, 0.02, 0.036), (0.93, 0.42, 0.08)),  # beak
    ((-0.165, 0.055, 0.0), (0.06, 0.035, 0.05), (0.94, 0.72, 0.10)),  # tail
    ((-0.02, 0.0, 0.115), (0.09, 0.055, 0.03), (0.90, 0.66, 0.08)),  # wings
    ((-0.02, 0.0, -0.115), (0.09, 0.055, 0.03), (0.90, 0.66, 0.08)),
    ((0.135, 0.175, 0.062), (0.016, 0.018, 0.016), (0.05, 0.05, 0.08)),  # eyes
    ((0.135, 0.175, -0.062), (0.016, 0.018, 0.016), (0.05, 0.05, 0.08)),
)
"""Centre, half axes [m] and colour of each part."""
INTERVAL = (0.30, 11.5)
"""True P-wave modulus over the one read, in 90 % of made films of unseen shapes (research/log/video.md, 2026-11-29): `pretrained` has no
reader of its own uncertainty."""


class Reading(NamedTuple):
    """What the demonstration read of the duck."""

    young: float
    """Young's modulus of the law that was read [Pa]."""
    low: float
    high: float
    """Ends of its 90 % interval [Pa]."""
    true: float
    rmse: float
    """Distance of matched particles between the two motions [m]."""
    seconds: float
    """From the images to the law [s]."""
    video: Path
    picture: Path


def duck(spacing: float, *, centre: tuple[float, float, float], velocity: tuple[float, float, float]) -> "tuple[Body, Tensor]":
    """Return a rubber duck and the colour of each of its particles (P, 3)."""
    import numpy as np
    import torch

    from neuido.types import Body

    axes = [np.arange(-0.3, 0.3, spacing) + spacing / 2] * 3
    x = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    x = x + spacing * 0.5 * (np.random.default_rng(0).random(x.shape) - 0.5)
    colour, inside = np.zeros_like(x), np.zeros(len(x), dtype=bool)
    for middle, half, own in ELLIPSOIDS:
        part = (((x - middle) / half) ** 2).sum(1) < 1
        colour[part], inside = own, inside | part
    x, colour = x[inside], colour[inside]
    place = torch.from_numpy(x + centre).float()
    v = torch.tensor(velocity).expand(len(x), 3).contiguous()
    return Body(place, v, torch.full((len(x),), spacing**3)), torch.from_numpy(colour).float()


def demo_reading(
    out: str = "runs/demo/reading", *, size: int = 512, frames: int = 80, spacing: float = 0.018, cells: int = 32, shown: int = 40
) -> Reading:
    """Film a falling rubber duck, read its law from two views in one pass, and show its motion beside the true one.

    Args:
        out: Folder for the video and the picture.
        size: Side of the images [px].
        frames: Number of frames, 5 ms apart.
        spacing: Distance of the particles [m].
        cells: Cells of the grid along the domain.
        shown: Number of frames of the video; the first ones are of the flight.
    """
    import time

    import torch

    from neuido.data.bodies.families import laws
    from neuido.data.cameras import intrinsics, look_at
    from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
    from neuido.models.operator.law_properties import small_strain_moduli
    from neuido.models.render.gaussians import deform, harmonics_of
    from neuido.models.render.splatting import render
    from neuido.models.video.encoder import DynamicsEncoder
    from neuido.models.video.flow import measure_velocities
    from neuido.physics.mpm.simulator import Simulator
    from neuido.types import Cameras, Gaussians, Scene, Walls

    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    print("[reading 1/3] filming a falling rubber duck", flush=True)
    body, colour = duck(spacing, centre=(0.42, 0.26, 0.5), velocity=(0.3, -2.2, 0.0))
    substeps = 5
    simulator = Simulator(Scene(cells=cells, dt=1e-3, walls=Walls(friction=math.inf)), body, density=1000.0, device="cpu")
    target, eyes = (0.53, 0.2, 0.5), ((0.75, 0.42, 2.3), (2.1, 0.6, 1.4))
    views = torch.stack([look_at(eye, target) for eye in eyes]).float()
    K = intrinsics(size, size, angle=math.radians(24)).float()
    cameras = Cameras(views, K.expand(2, 3, 3).contiguous(), size, size)
    covariance = ((0.62 * spacing) ** 2 * torch.eye(3)).expand(len(body.x), 3, 3).contiguous()
    gaussians = Gaussians(body.x, covariance, torch.full((len(body.x),), 0.95), harmonics_of(_speckled(colour, body.x)))

    def follow(own):
        return simulator.rollout(substeps * (frames - 1), *own, every=substeps)

    def draw(motion, wanted: Cameras):
        return render(deform(gaussians, motion.F, motion.x), wanted, background=torch.ones(3))

    with torch.no_grad():
        true = follow(laws("elastic", [{"young": TRUE_YOUNG, "poisson": POISSON}]))
        images, masks = (t.transpose(0, 1) for t in draw(true, cameras))
        print("[reading 2/3] its law in one pass", flush=True)
        operator, encoder = IntrinsicDynamicsOperator.load("pretrained").eval(), DynamicsEncoder.load("pretrained").eval()
        begun = time.perf_counter()
        seen = measure_velocities(images, masks, 1e-3 * substeps * torch.arange(frames), cameras, body.x.mean(0))
        z = encoder(*encoder.embed(seen))
        seconds = time.perf_counter() - begun
        young = float(small_strain_moduli(operator, z[None])[0][0])
        print("[reading 3/3] the motion under this law beside the true one", flush=True)
        read = follow(operator.laws(z))
        first = Cameras(views[:1], K[None], size, size)
        pick = torch.linspace(0, frames - 1, shown).round().long()
        learned = draw(type(read)(*(t[pick] for t in read)), first)[0][:, 0]
    recorded = images[0][pick]
    result = Reading(young, INTERVAL[0] * young, INTERVAL[1] * young, TRUE_YOUNG, float((read.x - true.x).square().sum(-1).mean() ** 0.5),
                     seconds, folder / "duck.mp4", folder / "duck.png")  # fmt: skip
    show(result, recorded, learned)
    print(f"E = {young / 1e3:.0f} kPa (90 %: {result.low / 1e3:.0f} to {result.high / 1e3:.0f} kPa), true {TRUE_YOUNG / 1e3:.0f} kPa; "
          f"particles {1e3 * result.rmse:.1f} mm from the true motion\nvideo: {result.video}")  # fmt: skip
    return result


def _speckled(colour: "Tensor", x: "Tensor") -> "Tensor":
    """Return colours with spots, without which no flow is seen in an even surface."""
    import torch

    wave = torch.sin(70 * x[:, 0] + 20 * x[:, 1]) * torch.sin(80 * x[:, 1] + 30 * x[:, 2]) * torch.sin(75 * x[:, 2] + 25 * x[:, 0])
    return (colour * (1 + 0.35 * wave[:, None])).clamp(0, 0.97)


def show(result: Reading, recorded: "Tensor", learned: "Tensor") -> None:
    """Write the video, recorded beside predicted, and a picture of four of its frames."""
    import cv2
    import numpy as np
    import torch

    from neuido.data.files.writing import write_png
    from neuido.models.inference.outputs import write_video as write_plain
    from neuido.viewer.recorder import write_video

    pairs: list[np.ndarray] = []
    for left, right in zip(recorded, learned, strict=True):
        frame = np.concatenate([_bytes(left), _bytes(right)], 1)
        side = left.shape[1]
        for at, words in ((0, "recorded"), (side, "predicted by the law that was read")):
            cv2.putText(frame, words, (at + side // 32, side // 16), cv2.FONT_HERSHEY_SIMPLEX, side / 900, (60, 60, 60), 1, cv2.LINE_AA)
        line = (
            f"E = {result.young / 1e3:.0f} kPa, 90 %: {result.low / 1e3:.0f} to {result.high / 1e3:.0f} kPa (true: {result.true / 1e3:.0f})"
        )
        cv2.putText(frame, line, (side // 32, side - side // 32), cv2.FONT_HERSHEY_SIMPLEX, side / 900, (60, 60, 60), 1, cv2.LINE_AA)
        pairs.append(frame)
    if find_spec("av") is None:  # of the extra `viewer`; OpenCV writes no H.264
        write_plain(result.video, torch.from_numpy(np.stack(pairs)) / 255, rate=15.0)
    else:
        write_video(result.video, pairs, 15.0)
    rows = [pairs[k] for k in np.linspace(0, 0.75 * len(pairs), 4).astype(int).clip(max=len(pairs) - 1)]
    write_png(result.picture, cv2.cvtColor(np.concatenate([np.concatenate(rows[:2], 1), np.concatenate(rows[2:], 1)]), cv2.COLOR_RGB2BGR))


def _bytes(image: "Tensor") -> "np.ndarray":
    return (255 * image.clamp(0, 1)).round().byte().cpu().numpy().copy()
