"""The `doctor` command: what is installed, what the machine offers, and whether the simulator and its gradient run on it."""

import platform
import re
import shutil
import subprocess
from importlib import metadata
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor, dtype

TOLERANCE = 1e-3
"""Largest relative difference between float32 and float64 that passes; a right rollout is near 1e-6."""


def doctor(*, data: str | None = None) -> int:
    """Print versions, devices, drivers and missing extras, and run a two-step rollout with its gradient on each device.

    Args:
        data: Folder of the measured data; the environment variable NEUIDO_DATA where absent.

    Returns:
        0, or 1 if a device fails.
    """
    _print_versions()
    devices = _print_devices()
    _print_data(data)
    print("\nrollout of two steps with its gradient, float32 against float64")
    failed = [device for device in devices if not _check_device(device)]
    print(f"\n{'failed: ' + ', '.join(failed) if failed else 'all devices ok'}")
    return 1 if failed else 0


def _print_versions() -> None:
    print(f"neuido {_version('neuido') or 'not installed'}, Python {platform.python_version()}, {platform.platform()}")
    try:
        requirements = metadata.requires("neuido") or []
    except metadata.PackageNotFoundError:
        print("  the package is not installed: pip install -e . in its folder")
        return
    missing: dict[str, list[str]] = {}
    for requirement in requirements:
        name = re.match(r"[\w.-]+", requirement)[0]  # type: ignore[index]
        extra = re.search(r"extra == ['\"]([\w-]+)", requirement)
        version = _version(name)
        if version is None:
            missing.setdefault(extra[1] if extra else "", []).append(name)
        elif not extra:
            print(f"  {name:<24}{version}")
    for extra, names in missing.items():
        print(f"  missing: {', '.join(names)} (pip install '{f'neuido[{extra}]' if extra else 'neuido'}')")


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _print_devices() -> list[str]:
    """Print what torch and Warp see, and return the devices that a rollout should run on."""
    import torch
    import warp as wp

    from neuido.physics.runtime.device import start_warp

    start_warp()
    toolkit, driver = wp.get_cuda_toolkit_version(), wp.get_cuda_driver_version()
    print(f"\ndevices\n  cpu: {torch.get_num_threads()} threads, float32 and float64")
    for i in range(torch.cuda.device_count()):
        properties = torch.cuda.get_device_properties(i)
        print(f"  cuda:{i}: {properties.name}, {properties.total_memory / 2**30:.0f} GiB, compute {properties.major}.{properties.minor}")
    release = _driver_release()
    dotted = ["none" if version is None else ".".join(map(str, version)) for version in (toolkit, driver)]
    print(f"  driver {release or 'none'} (CUDA {dotted[1]}); built for CUDA: torch {torch.version.cuda or 'none'}, warp {dotted[0]}")
    if release and not torch.cuda.is_available():
        print("  torch does not see the GPU: install a CUDA build of torch (README, Install)")
    if toolkit and (driver or release) and (driver or (0,))[0] < toolkit[0]:
        print(f"  the driver is too old for this warp, which needs one for CUDA {toolkit[0]} (R580 or later for CUDA 13): "
              "update the driver, or install a +cu12 wheel from warp's releases")  # fmt: skip
    return ["cpu", *(f"cuda:{i}" for i in range(torch.cuda.device_count()))]


def _driver_release() -> str | None:
    """Read the NVIDIA driver's release, such as 580.159; None without a driver."""
    if shutil.which("nvidia-smi") is None:
        return None
    command = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    answer = subprocess.run(command, capture_output=True, text=True, timeout=30)
    return answer.stdout.split("\n")[0].strip() or None if answer.returncode == 0 else None


def _print_data(option: str | None) -> None:
    from neuido.data.bodies.scene_files import data_root
    from neuido.errors import UserError

    try:
        print(f"\ndata\n  {data_root(option)}")
    except UserError as error:
        print(f"\ndata\n  {error}")


def _check_device(device: str) -> bool:
    import torch

    try:
        single, double = _rollout(device, torch.float32), _rollout(device, torch.float64)
    except Exception as error:  # whatever stops a device is the finding
        print(f"  {device}: failed: {type(error).__name__}: {' '.join(str(error).split())}")
        return False
    difference = max(float((a.double() - b).norm() / b.norm()) for a, b in zip(single, double, strict=True))
    ok = difference <= TOLERANCE  # a NaN fails
    print(f"  {device}: {'ok' if ok else 'failed'}: relative difference {difference:.1e} (at most {TOLERANCE:g})")
    return ok


def _rollout(device: str, dtype: "dtype") -> "tuple[Tensor, ...]":
    """Deformation after two substeps of a sheared cube, and the gradient of a functional of it w.r.t. x, v and F."""
    import torch

    from neuido.physics.laws.classical import FixedCorotated
    from neuido.physics.mpm.simulator import Simulator
    from neuido.types import Body, ParticleState, Scene

    axis = torch.linspace(0.4, 0.6, 5, dtype=torch.float64)
    x = torch.cartesian_prod(axis, axis, axis)
    v = torch.stack([torch.sin(9 * x[:, 1]), torch.cos(7 * x[:, 2]), x[:, 0] * x[:, 1]], dim=1)
    F = torch.eye(3, dtype=torch.float64) + 0.05 * torch.sin(torch.arange(9 * len(x), dtype=torch.float64)).reshape(-1, 3, 3)
    body = Body(x, v, torch.full((len(x),), 0.05**3, dtype=torch.float64), F)
    simulator = Simulator(Scene(cells=16, dt=1e-3), body, device=device, dtype=dtype)
    start = ParticleState(*(t.detach().clone().requires_grad_() for t in simulator.state))
    end = simulator.rollout(2, FixedCorotated(1e5, 0.3), state=start)
    weights = torch.cos(torch.arange(end.F[-1].numel(), device=device, dtype=torch.float64)).reshape(end.F[-1].shape).to(dtype)
    gradients = torch.autograd.grad((end.F[-1] * weights).sum(), [start.x, start.v, start.F])
    return (end.F[-1].detach(), *gradients)
