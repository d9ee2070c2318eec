"""One small motion, written in the exact layout of each format. Nothing here uses the package: it is the oracle of its readers."""

import json
import math
import struct
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

WIDTH, HEIGHT, FOCAL = 24, 16, 30.0
POINT = np.array([0.12, -0.05, 0.2])


@dataclass
class Sample:
    """Three cameras, four frames of RGBA images of a soft blob."""

    centres: np.ndarray = field(default_factory=lambda: np.array([[0.0, 0.4, 3.0], [2.5, 0.8, 1.0], [-1.0, 1.5, -2.5]]))
    frame_count: int = 4
    interval: float = 0.02

    @property
    def c2w(self) -> np.ndarray:
        """OpenGL camera to world (3, 4, 4): columns right, up, backward, centre."""
        out = np.tile(np.eye(4), (len(self.centres), 1, 1))
        for pose, centre in zip(out, self.centres):
            back = centre / np.linalg.norm(centre)
            right = np.cross([0.1, 1.0, 0.05], back)  # tilted, so that no axis stays level
            right /= np.linalg.norm(right)
            pose[:3] = np.column_stack([right, np.cross(back, right), back, centre])
        return out

    @property
    def w2c(self) -> np.ndarray:
        """OpenCV world to camera (3, 4, 4)."""
        return np.linalg.inv(self.c2w @ np.diag([1.0, -1.0, -1.0, 1.0]))

    @property
    def K(self) -> np.ndarray:
        return np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])

    @property
    def times(self) -> np.ndarray:
        return self.interval * np.arange(self.frame_count)

    @property
    def images(self) -> np.ndarray:
        """RGBA (3, T, H, W, 4) uint8, different in each channel, view and frame."""
        v, t, i, j = np.meshgrid(*(np.arange(n) for n in (3, self.frame_count, HEIGHT, WIDTH)), indexing="ij")
        inside = (i - 8 - v) ** 2 + (j - 10 - 2 * t) ** 2 < 25
        rgba = np.stack([40 + 60 * v + 4 * i, 30 + 40 * t + 2 * j, 200 - 5 * j, 255 * inside], axis=-1)
        return rgba.astype(np.uint8)

    def pixels(self, point: np.ndarray = POINT) -> np.ndarray:
        """Where the cameras see the point, by NeRF's own formula of a ray: (x - cx)/f, -(y - cy)/f, -1. (3, 2)."""
        out = []
        for pose in self.c2w:
            d = pose[:3, :3].T @ (point - pose[:3, 3])
            d = d / -d[2]
            out.append([FOCAL * d[0] + WIDTH / 2, -FOCAL * d[1] + HEIGHT / 2])
        return np.array(out)


def png(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    order = {3: cv2.COLOR_RGB2BGR, 4: cv2.COLOR_RGBA2BGRA}
    assert cv2.imwrite(str(path), image if image.ndim == 2 else cv2.cvtColor(image, order[image.shape[2]]))


def dump(path: Path, content) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))


def nerfstudio(folder: Path, s: Sample) -> Path:
    frames = []
    for v in range(3):
        for t in range(s.frame_count):
            png(folder / f"images/{v}_{t:03d}.png", s.images[v, t])
            frames.append(
                {"file_path": f"images/{v}_{t:03d}.png", "transform_matrix": s.c2w[v].tolist(), "time": float(s.times[t]), "view": v}
            )
    lens = {"camera_model": "OPENCV", "fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT}
    dump(folder / "transforms.json", lens | {"frames": frames})
    return folder


def blender(folder: Path, s: Sample) -> Path:
    """View 2 is the test set; the endings are left away."""
    angle = 2 * math.atan(0.5 * WIDTH / FOCAL)
    for split, views in (("train", (0, 1)), ("test", (2,))):
        frames = []
        for v in views:
            for t in range(s.frame_count):
                png(folder / f"{split}/r_{v}_{t}.png", s.images[v, t])
                frames.append(
                    {
                        "file_path": f"./{split}/r_{v}_{t}",
                        "rotation": 0.0,
                        "time": float(s.times[t]),
                        "transform_matrix": s.c2w[v].tolist(),
                    }
                )
        dump(folder / f"transforms_{split}.json", {"camera_angle_x": angle, "frames": frames})
    return folder


def neuma_synthetic(folder: Path, s: Sample, scale: float = 0.41) -> Path:
    """Views d_0, d_1 to train and e_0 to score, with BouncyBall's scaled rotations; frame -1 is one that NeuMA excludes."""
    for part, names in (("data_dynamic", {0: "d_0", 1: "d_1"}), ("eval_dynamic", {2: "e_0"})):
        entries = []
        for v, name in names.items():
            c2w = s.c2w[v].copy()
            c2w[:3, :3] *= scale
            for t in range(-1, s.frame_count):
                png(folder / part / f"{name}_{t:03d}.png", s.images[v, max(t, 0)])
                entries.append({"file_path": f"./{part}/{name}_{t:03d}.png", "c2w": c2w[:3].tolist(), "intrinsic": s.K.tolist()})
        dump(folder / f"{part}.json", entries)
    return folder


def neuma_real(folder: Path, s: Sample) -> Path:
    cameras_bin(folder / "sparse/0/cameras.bin", 4 * WIDTH, 4 * HEIGHT, 4 * FOCAL)
    calibration = {}
    for v in range(3):
        calibration[f"r_{v}"] = rodrigues(s.w2c[v])
        for t in range(s.frame_count):
            png(folder / f"dynamics/r_{v}_{t}.jpg", s.images[v, t, ..., :3])
            png(folder / f"dynamic_masks/r_{v}_{t}.png", s.images[v, t, ..., 3])
    dump(folder / "cameras_calib.json", calibration)
    return folder


def pacnerf(folder: Path, s: Sample, *, segmented: bool = False) -> Path:
    """The object in front of a grey room; frame -1 is the room, frame -2 an occluder's alpha."""
    entries = []
    room = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
    for v in range(3):
        for t in range(-2, s.frame_count):
            rgba = s.images[v, max(t, 0)]
            seen = np.where(rgba[..., 3:] > 0, rgba[..., :3], room) if t >= 0 else room
            png(folder / f"data/r_{v}_{t}.png", seen if t != -2 else np.concatenate([room, 0 * room[..., :1]], axis=2))
            if segmented and t >= 0:
                png(folder / f"data/a_{v}_{t}.png", rgba)
            entries.append(
                {
                    "file_path": f"./data/r_{v}_{t}.png",
                    "c2w": s.c2w[v, :3].tolist(),
                    "intrinsic": s.K.tolist(),
                    "time": max(t, 0) * s.interval,
                }
            )
    dump(folder / "all_data.json", entries)
    return folder


def springgaus_synthetic(folder: Path, s: Sample) -> Path:
    cameras = []
    for v in range(3):
        cameras.append({"camera": f"cam_{v}", "K": s.K.tolist(), "c2w": s.c2w[v].tolist()})
        for t in range(s.frame_count):
            png(folder / f"cam_{v}/{t:03d}.png", s.images[v, t])
    dump(folder / "camera.json", cameras)
    return folder


def springgaus_real(folder: Path, s: Sample) -> Path:
    names = ("C0733", "C0787", "C0801")
    sequence = {"hit_frame": 2}
    for v, name in enumerate(names):
        sequence[name] = [f"{name}_{100 + t}.jpg" for t in range(s.frame_count)]
        for t, file in enumerate(sequence[name]):
            png(folder / "dynamic/videos_images" / name / file, s.images[v, t, ..., :3])
            png(folder / "dynamic/videos_masks" / name / file.replace(".jpg", ".png"), s.images[v, t, ..., 3])
    dump(folder / "dynamic/cameras_calib.json", {name: rodrigues(s.w2c[v], column=True) for v, name in enumerate(names)})
    dump(folder / "dynamic/sync.json", {name: 0 for name in names})
    dump(folder / "dynamic/sequences/bun/0.json", sequence)
    stills(folder / "static/colmap/bun", folder / "static/images/bun", s, ending=".JPG", masks=folder / "static/masks/bun")
    return folder


def colmap(folder: Path, s: Sample) -> Path:
    stills(folder / "sparse/0", folder / "images", s, ending=".png")
    return folder


def stills(model: Path, pictures: Path, s: Sample, *, ending: str, masks: Path | None = None) -> None:
    """The first frame as a COLMAP model; the ids of the images are not in the order of their names."""
    cameras_bin(model / "cameras.bin", WIDTH, HEIGHT, FOCAL)
    data = struct.pack("<Q", 3)
    for v in (2, 0, 1):
        data += struct.pack("<i7di", v + 1, *quaternion(s.w2c[v, :3, :3]), *s.w2c[v, :3, 3], 1)
        data += f"IMG_{v}{ending}".encode() + b"\0" + struct.pack("<Q", 2) + struct.pack("<ddqddq", 1.0, 2.0, -1, 3.0, 4.0, 7)
        png(pictures / f"IMG_{v}{ending}", s.images[v, 0, ..., :3])
        if masks is not None:
            png(masks / f"IMG_{v}.png", s.images[v, 0, ..., 3])
    (model / "images.bin").write_bytes(data)


def cameras_bin(path: Path, width: int, height: int, focal: float) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(struct.pack("<QiiQQ4d", 1, 1, 1, width, height, focal, focal, width / 2, height / 2))  # a PINHOLE


def rodrigues(w2c: np.ndarray, *, column: bool = False) -> dict:
    r, t = cv2.Rodrigues(w2c[:3, :3])[0], w2c[:3, 3:]
    return {"rvecs": (r if column else r[:, 0]).tolist(), "tvecs": (t if column else t[:, 0]).tolist()}


def quaternion(R: np.ndarray) -> np.ndarray:
    """w, x, y, z from the axis and the angle."""
    r = cv2.Rodrigues(R)[0][:, 0]
    angle = np.linalg.norm(r)
    return np.array([math.cos(angle / 2), *(math.sin(angle / 2) * r / angle)])


def experiment(folder: Path, s: Sample) -> Path:
    """One filmed recording with a body, one without images and with another gravity and a hung mass."""
    text = """
format: neuido-experiment/1
name: soft-cube
scene:
  domain: [[0, 0, 0], [1, 1, 1]]
  gravity: [0, -9.8, 0]
  colliders:
    - {type: plane, point: [0, 0.1, 0], normal: [0, 1, 0], contact: separate, friction: 0.2}
  clamps:
    - {box: [[0.3, 0.3, 0.3], [0.7, 0.35, 0.7]]}
model:
  density: 1000.0
  elasticity: {law: fixed_corotated, young: 1.0e5, poisson: 0.3}
  plasticity: {law: von_mises, yield_stress: 2e3}
  free: [young, yield_stress]
discretisation: {grid: 32, dt: 5.0e-4}
recordings:
  - {name: drop, role: fit, frame_interval: 0.02, noise: 0.0005}
  - name: loaded
    role: held_out
    frame_interval: 0.02
    gravity: [0, 0, 0]
    attached_masses:
      - {box: [[0.3, 0.6, 0.3], [0.7, 0.7, 0.7]], mass: 0.052}
"""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "experiment.yaml").write_text(text)
    nerfstudio(folder / "drop", s)
    (folder / "loaded").mkdir()
    np.savez(folder / "drop" / "particles.npz", **particles(s, track=True))
    np.savez(folder / "loaded" / "particles.npz", **particles(s, track=False))
    (folder / "drop" / "gaussians.ply").write_bytes(b"ply\n")
    return folder


def particles(s: Sample, *, track: bool) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    x0 = np.stack(np.meshgrid(*3 * [np.linspace(0.32, 0.68, 5)], indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)
    follow = np.array([3, 60, 124], np.int32)
    x = x0[follow] + rng.normal(0, 1e-3, (s.frame_count, 3, 3))
    x[1, 2] = np.nan
    arrays = {"x": x.astype(np.float32), "t": s.times, "x0": x0, "v0": np.full_like(x0, 0.1), "volume": np.full(125, 4e-4, np.float32)}
    if track:
        return arrays | {"track": np.where(follow == 60, -1, follow).astype(np.int32)}
    return arrays | {"anchor": x0[follow], "F0": np.tile(np.diag([1.1, 0.9, 1.0]), (125, 1, 1)).astype(np.float32)}
