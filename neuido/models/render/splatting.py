"""Differentiable Gaussian splatting with the conventions of gsplat, for all frames and views in one call.

Images of 3D Gaussians (Kerbl et al. 2023) follow the rules of gsplat: OpenCV cameras, pixel centres at +0.5, `eps2d` added to the
covariance in pixels, alpha between 1/255 and 0.999, early termination at a transmittance of 1e-4, no antialiasing. Gaussians are sorted by
the depth of their centres. The tiles of a Gaussian cover every pixel to which it contributes, so the tiling does not affect the image.

There are three back ends: `warp` (own kernels for CPU and CUDA), `torch` (the slow reference), and `gsplat`, if it is installed.
"""

import math

import torch
import warp as wp
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from neuido.errors import UserError
from neuido.models.render import compose_kernels, splat_reference
from neuido.models.render.gaussians import colours_of, degree_of
from neuido.models.render.splat_kernels import ROWS, build
from neuido.physics.runtime.device import launch, real_of, torch_stream
from neuido.types import Cameras, Gaussians

BACKENDS = ("auto", "warp", "torch", "gsplat")
TILE = {"cpu": 8, "cuda": 16}
"""Side of a tile [pixels]: small tiles are faster on the CPU, which has no shared memory to fill."""

INDEX_LIMIT = 2**31 - 1
"""Largest index of the kernels, which use 32-bit integers."""


def one_thread_per_tile(device: torch.device) -> bool:
    """Return whether one thread composes a whole tile, splat by splat (CPU), rather than one pixel (CUDA)."""
    return device.type == "cpu"


def rasterize(
    means: Tensor,  # (..., N, 3)
    covariances: Tensor,  # (..., N, 3, 3)
    opacities: Tensor,  # (N,) or (..., N)
    colours: Tensor,  # (N, 3) or (..., N, 3); with sh_degree (N, K, 3)
    viewmats: Tensor,  # (V, 4, 4), or (V, T, 4, 4) for cameras that move
    Ks: Tensor,  # (V, 3, 3)
    width: int,
    height: int,
    *,
    sh_degree: int | None = None,
    rotations: Tensor | None = None,  # (..., N, 3, 3)
    background: Tensor | None = None,  # (3,) or broadcastable to (..., V, H, W, 3)
    near: float = 0.01,
    far: float = 1e10,
    eps2d: float = 0.3,
    backend: str = "auto",
    capacity: int | None = None,
) -> tuple[Tensor, Tensor]:
    """Render Gaussians for all frames (the leading dimensions) and all views at once.

    The images are differentiable with respect to means, covariances, opacities, colours, rotations and background, but not cameras. The
    gradients of opacities and colours are only computed if needed, those of means and covariances always.

    Args:
        means: Centres [m].
        covariances: Covariances [m^2]; only the symmetric part is used.
        opacities: Opacities in 0..1.
        colours: RGB, or spherical harmonics if `sh_degree` is given; then RGB = max(0, 1/2 + harmonics in the viewing direction).
        viewmats: World-to-camera matrices, OpenCV convention. With a pose for each frame, the leading dimension of the means is the frame,
            and the first poses are used where there are more of them than frames.
        Ks: Intrinsics [pixels]; skew is ignored.
        width: Image width [pixels].
        height: Image height [pixels].
        sh_degree: Degree of the spherical harmonics, 0 to 3.
        rotations: Rotation of each Gaussian relative to its harmonics; the viewing direction is rotated back by it.
        background: RGB behind the Gaussians; black where absent.
        near: Near plane [m]; Gaussians with closer centres are not drawn.
        far: Far plane [m]; Gaussians with centres beyond it are not drawn.
        eps2d: Number added to the diagonal of the covariance in pixels [pixels^2].
        backend: `warp`, `torch`, `gsplat`, or `auto` (warp).
        capacity: Maximum total length of the tile lists on CUDA. With it, the call never synchronises with the device and can be captured
            in a CUDA graph; images are NaN if it is too small. Without it, the call reads one number back after its launches.

    Returns:
        Images (..., V, H, W, 3), and alphas (..., V, H, W): the coverage of each pixel by Gaussians.

    Raises:
        UserError: Shapes do not match, a number is not finite, or the back end is not available.
    """
    if viewmats.dim() == 4:
        parts = _frame_by_frame(means, covariances, opacities, colours, viewmats, rotations, background, sh_degree)
        options = {"sh_degree": sh_degree, "near": near, "far": far, "eps2d": eps2d, "backend": backend, "capacity": capacity}
        drawn = [rasterize(*part[:4], part[4], Ks, width, height, rotations=part[5], background=part[6], **options) for part in parts]
        return torch.stack([image for image, _ in drawn]), torch.stack([alpha for _, alpha in drawn])
    frames, means, covariances, opacities = _frames(means, covariances, opacities, viewmats, Ks)
    if backend not in BACKENDS:
        raise UserError(f"backend is {backend!r}; one of {', '.join(BACKENDS)}")
    if width < 1 or height < 1:
        raise UserError(f"width and height are {width} and {height}; at least 1 each")
    viewmats, Ks = viewmats.detach().to(means), Ks.detach().to(means)
    tints = _view_colours(colours, means, viewmats, sh_degree, rotations, frames)
    arguments = (means, covariances, opacities, tints, viewmats, Ks, width, height, near, far, eps2d)
    if backend == "torch":
        images, alphas = splat_reference.rasterize(*arguments)
    elif backend == "gsplat":
        images, alphas = _gsplat(*arguments)
    else:
        images, alphas = _Splat.apply(*arguments, capacity)
    images, alphas = images.unflatten(0, frames) if frames else images[0], alphas.unflatten(0, frames) if frames else alphas[0]
    if background is not None:
        images = images + (1 - alphas).unsqueeze(-1) * background.to(images)
    return images, alphas


def render(gaussians: Gaussians, cameras: Cameras, **options) -> tuple[Tensor, Tensor]:
    """Render Gaussians with cameras; `options` are keyword arguments of `rasterize`."""
    degree = degree_of(gaussians.harmonics)
    means, covariances, opacities, harmonics, rotations = gaussians
    return rasterize(means, covariances, opacities, harmonics, *cameras, sh_degree=degree, rotations=rotations, **options)


class Splatting(nn.Module):
    """Module that calls `render` with stored options; the arguments are those of `rasterize`."""

    def __init__(
        self,
        background: tuple[float, float, float] | None = None,
        near: float = 0.01,
        far: float = 1e10,
        eps2d: float = 0.3,
        backend: str = "auto",
        capacity: int | None = None,
    ):
        super().__init__()
        self.register_buffer("background", None if background is None else torch.tensor(background), persistent=False)
        self.options = {"near": near, "far": far, "eps2d": eps2d, "backend": backend, "capacity": capacity}

    def forward(self, gaussians: Gaussians, cameras: Cameras) -> tuple[Tensor, Tensor]:
        """Return images (..., V, H, W, 3) and alphas (..., V, H, W)."""
        return render(gaussians, cameras, background=self.background, **self.options)


def _frame_by_frame(
    means: Tensor,
    covariances: Tensor,
    opacities: Tensor,
    colours: Tensor,
    viewmats: Tensor,
    rotations: Tensor | None,
    background: Tensor | None,
    sh_degree: int | None,
):
    """Yield the arguments of `rasterize` for each frame: means, covariances, opacities, colours, viewmats, rotations and background."""
    if means.dim() != 3 or len(means) > viewmats.shape[1]:
        raise UserError(
            f"means have shape {tuple(means.shape)}; needed (K, N, 3) with at most {viewmats.shape[1]} frames, for which the cameras "
            "have a pose; `Cameras.at(frame)` holds a camera still"
        )
    given = (
        (covariances, covariances.dim() == 4),
        (opacities, opacities.dim() == 2),
        (colours, sh_degree is None and colours.dim() == 3),
        (rotations, rotations is not None and rotations.dim() == 4),
        (background, background is not None and background.dim() == 5),
    )
    for k in range(len(means)):
        own = [t[k] if t is not None and each else t for t, each in given]
        yield means[k], own[0], own[1], own[2], viewmats[:, k], own[3], own[4]


def _frames(means: Tensor, covariances: Tensor, opacities: Tensor, viewmats: Tensor, Ks: Tensor):
    """Return the leading dimensions, and means (F, N, 3), covariances (F, N, 3, 3) and opacities (1 or F, N)."""
    if means.dim() < 2 or means.shape[-1] != 3:
        raise UserError(f"means have shape {tuple(means.shape)}; needed (..., N, 3)")
    if means.dtype not in (torch.float32, torch.float64):
        raise UserError(f"means are {means.dtype}; needed float32 or float64")
    frames, count = means.shape[:-2], means.shape[-2]
    wanted = (
        ("covariances", covariances, ((*frames, count, 3, 3), (count, 3, 3))),
        ("opacities", opacities, ((*frames, count), (count,))),
        ("viewmats", viewmats, ((len(viewmats), 4, 4),)),
        ("Ks", Ks, ((len(viewmats), 3, 3),)),
    )
    for name, tensor, shapes in wanted:
        if tuple(tensor.shape) not in shapes:
            raise UserError(f"{name} have shape {tuple(tensor.shape)}; needed {' or '.join(map(str, dict.fromkeys(shapes)))}")
        if tensor.device != means.device:
            raise UserError(f"{name} are on {tensor.device} and means on {means.device}; needed on one device")
    many = math.prod(frames)
    covariances = covariances.to(means.dtype).expand(*frames, count, 3, 3).reshape(many, count, 3, 3)
    opacities = opacities.to(means.dtype).reshape(many if opacities.dim() > 1 else 1, count)
    return frames, means.reshape(many, count, 3), covariances, opacities


def _view_colours(colours: Tensor, means: Tensor, viewmats: Tensor, sh_degree: int | None, rotations: Tensor | None, frames) -> Tensor:
    """Return the RGB of each Gaussian, (1 or F, 1 or V, N, 3)."""
    count = means.shape[1]
    if colours.device != means.device:
        raise UserError(f"colours are on {colours.device} and means on {means.device}; needed on one device")
    if sh_degree is None:
        shapes = ((count, 3), (*frames, count, 3))
        if tuple(colours.shape) not in shapes:
            raise UserError(f"colours have shape {tuple(colours.shape)}; needed {' or '.join(map(str, dict.fromkeys(shapes)))}")
        return colours.to(means.dtype).reshape(len(means) if colours.dim() > 2 else 1, 1, count, 3)
    if colours.dim() != 3 or len(colours) != count or colours.shape[2] != 3:
        raise UserError(f"harmonics have shape {tuple(colours.shape)}; needed ({count}, K, 3)")
    colours = colours.to(means.dtype)
    if sh_degree == 0:
        return colours_of(colours, None, degree=0)[None, None]
    eyes = -(viewmats[:, :3, :3].mT @ viewmats[:, :3, 3:]).mT
    directions = means[:, None] - eyes
    if rotations is not None:
        directions = (rotations.reshape(len(means), 1, count, 3, 3).mT @ directions.unsqueeze(-1)).squeeze(-1)
    return colours_of(colours, directions, degree=sh_degree)


def _gsplat(means, covariances, opacities, colours, viewmats, Ks, width, height, near, far, eps2d) -> tuple[Tensor, Tensor]:
    try:
        from gsplat import rasterization  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise UserError("backend 'gsplat' is not installed: pip install 'neuido[gpu]', or use backend 'warp'") from error
    if not means.is_cuda:
        raise UserError(f"backend 'gsplat' needs CUDA tensors, got {means.device}; use backend 'warp'")
    frames, views, count = len(means), len(viewmats), means.shape[1]
    images, alphas, _ = rasterization(
        means,
        None,
        None,
        opacities.expand(frames, count).contiguous(),
        colours.expand(frames, views, count, 3).contiguous(),
        viewmats.expand(frames, views, 4, 4).contiguous(),
        Ks.expand(frames, views, 3, 3).contiguous(),
        width,
        height,
        near_plane=near,
        far_plane=far,
        eps2d=eps2d,
        packed=False,
        covars=(covariances + covariances.mT) / 2,
    )
    return images, alphas.squeeze(-1)


class _TileLists:
    """Splats of each tile, front to back: a flat list `splats`, and the `ranges` of the tiles in it (C tiles, 2)."""

    splats: Tensor
    ranges: Tensor
    broken: Tensor | None = None
    """With a capacity, a bool on the device: whether the capacity was too small or a number was not finite."""
    entries: "_Entries | None" = None
    """Length of all lists, from CUDA without a capacity."""


def _lists_by_counting(kernels, splat, depth: Tensor, status: Tensor, columns: int, tiles: int) -> _TileLists:
    """Build the tile lists on the CPU: sort the Gaussians by depth, then apply a counting sort by tile."""
    images, count = depth.shape
    lists = _TileLists()
    length = torch.zeros(images * tiles, dtype=torch.int32)
    launch(kernels.tally, images, [splat[2], count, columns, tiles, length], depth.device)
    ends = length.cumsum(0)
    _check(int(status), total := int(ends[-1]))
    slot = (ends - length).int()
    lists.ranges = torch.stack([slot, ends.int()], 1)
    lists.splats = torch.empty(max(total, 1), dtype=torch.int32)
    keys = torch.stack([depth, depth], 1)  # the radix sort needs twice the space
    order = torch.arange(count, dtype=torch.int32).repeat(images, 2, 1)
    for k, o in zip(keys.flatten(1), order.flatten(1)):
        wp.utils.radix_sort_pairs(wp.from_torch(k), wp.from_torch(o), count)
    launch(kernels.fill, images, [splat[2], order.view(-1), count, columns, tiles, slot, lists.splats], depth.device)
    return lists


class _Entries:
    """Number of entries of the tile lists, on its way from the device.

    Args:
        numbers: Number of broken Gaussians, and of entries, (2,) int64 on the device.
    """

    def __init__(self, numbers: Tensor) -> None:
        self.host, self.arrived = numbers, None
        if numbers.is_cuda:
            self.host = torch.empty(2, dtype=torch.int64, pin_memory=True).copy_(numbers, non_blocking=True)
            self.arrived = torch.cuda.Event()
            self.arrived.record(torch.cuda.current_stream(numbers.device))

    def wait(self) -> int:
        """Return the number of entries.

        Raises:
            UserError: Numbers are not finite, or there are too many entries.
        """
        if self.arrived is not None:
            self.arrived.synchronize()
        bad, total = self.host.tolist()
        _check(bad, total)
        return total


ROOM, LARGEST_ROOM = 1.125, 1.5
"""Room of the tile lists relative to the entries of a call, when it is chosen and at most. Views and frames differ by some per cent; a call
whose entries do not fit is drawn twice; one size is kept, so that memory and recorded launches are used again."""
_rooms: dict[tuple, int] = {}


def room_of(images: int, gaussians: int) -> int | None:
    """Return the largest room that calls of this size on CUDA have now, as a `capacity` to begin with; None before the first."""
    return max((room for (_, *size, _), room in _rooms.items() if size == [images, gaussians]), default=None)


def _set_room(key: tuple, total: int) -> None:
    """Choose the room of the next call of a size from the entries of this one."""
    if not total <= _rooms.get(key, -1) <= LARGEST_ROOM * total:
        if len(_rooms) > 1000:
            _rooms.clear()
        _rooms[key] = min(int(ROOM * total) + 1, INDEX_LIMIT)


def _lists_by_key(
    kernels, splat, depth: Tensor, status: Tensor, columns: int, tiles: int, capacity: int | None, room: int | None = None
) -> _TileLists:
    """Build the tile lists on CUDA by one sort of keys that combine tile and depth.

    Only the device knows the length of the lists. With `room`, what follows can be launched before the length has arrived
    (`_TileLists.entries`); if it exceeds the room, the lists are incomplete and must be built again.
    """
    images, count = depth.shape
    device = depth.device
    lists = _TileLists()
    found = torch.empty(images * count, dtype=torch.int32, device=device)
    launch(kernels.count, images * count, [*splat, found], device)
    ends = found.cumsum(0)
    if capacity is not None:
        total = capacity
        lists.broken = (ends[-1] > capacity) | (status[0] > 0)
    else:
        lists.entries = _Entries(torch.stack([status[0].long(), ends[-1]]))
        total = lists.entries.wait() if room is None else room
    keys = torch.full((max(total, 1),), 2**63 - 1, dtype=torch.int64, device=device)
    splats = torch.empty(max(total, 1), dtype=torch.int32, device=device)
    launch(kernels.emit, images * count, [*splat, depth.view(-1), ends, count, columns, tiles, keys, splats], device)
    keys, order = torch.sort(keys, stable=True)
    lists.splats = splats[order]
    lists.ranges = torch.zeros(images * tiles, 2, dtype=torch.int32, device=device)
    launch(kernels.ranges, len(keys), [keys, lists.ranges], device)
    return lists


def _check(bad: int, total: int) -> None:
    if bad:
        raise UserError(f"{bad} projected Gaussians have numbers that are not finite: check means, covariances and opacities")
    if total > INDEX_LIMIT:
        raise UserError(f"{total} entries of Gaussians in tiles exceed 2^31: render fewer frames or views in one call")


class _Splat(torch.autograd.Function):
    """Map means (F, N, 3), covariances (F, N, 3, 3), opacities (1 or F, N) and colours (1 or F, 1 or V, N, 3) to images and alphas."""

    @staticmethod
    def forward(ctx, means, covariances, opacities, colours, viewmats, Ks, width, height, near, far, eps2d, capacity):
        frames, count = means.shape[:2]
        views, device = len(viewmats), means.device
        images, dtype = frames * views, means.dtype
        if images * count == 0:
            ctx.shapes = [t.shape for t in (means, covariances, opacities, colours)]
            return means.new_zeros(frames, views, height, width, 3), means.new_zeros(frames, views, height, width)
        side = TILE[device.type]
        columns, tiles = -(-width // side), -(-width // side) * -(-height // side)
        if max(images * count * ROWS, images * tiles * side * side) > INDEX_LIMIT:
            raise UserError(f"{images} images of {count} Gaussians exceed 2^31 entries: render fewer frames or views in one call")
        kernels = build(real_of(dtype), side)
        means, covariances, opacities, colours = (t.detach().contiguous() for t in (means, covariances, opacities, colours))
        viewmats, Ks = viewmats.contiguous(), Ks.contiguous()
        new = {"dtype": dtype, "device": device}
        centre, conic = torch.empty(images * count, 4, **new), torch.empty(images * count, 3, **new)
        box = torch.empty(images * count, 4, dtype=torch.int32, device=device)
        depth = torch.empty(images, count, **new)
        status = torch.zeros(1, dtype=torch.int32, device=device)
        stride = count if len(opacities) > 1 else 0
        strides = (colours.shape[1] * count if len(colours) > 1 else 0, count if colours.shape[1] > 1 else 0)
        if one_thread_per_tile(device):
            image, clear = torch.zeros(frames, views, height, width, 3, **new), torch.ones(frames, views, height, width, **new)
            last = torch.zeros(frames, views, height, width, dtype=torch.int32, device=device)
        else:  # each pixel is written
            image, clear = torch.empty(frames, views, height, width, 3, **new), torch.empty(frames, views, height, width, **new)
            last = torch.empty(frames, views, height, width, dtype=torch.int32, device=device)
        with torch_stream(device):
            inputs = [means.view(-1, 3), covariances.view(-1, 3, 3), opacities.view(-1), stride, viewmats, Ks, count, width, height]
            flat = depth.view(-1)
            launch(kernels.project, images * count, [*inputs, near, far, eps2d, centre, conic, box, flat, status], device)
            found = (kernels, (centre, conic, box), depth, status, columns, tiles)
            rest = [colours.view(-1, 3), *strides, count, views, width, height, columns, tiles]
            result = [image.view(-1, 3), clear.view(-1), last.view(-1)]
            blend = compose_kernels.build(real_of(dtype), side)
            if one_thread_per_tile(device):
                lists = _lists_by_counting(*found)
                launch(blend.compose_tile, images * tiles, [lists.ranges, lists.splats, centre, conic, box, *rest, *result], device)
            else:
                size = (device, images, count, tiles)
                room = _rooms.get(size)
                lists = _lists_by_key(*found, capacity, room)
                pixels = images * tiles * side * side
                launch(blend.compose, pixels, [lists.ranges, lists.splats, centre, conic, *rest, *result], device)
                if lists.entries is not None:
                    total = lists.entries.wait()
                    if room is not None and total > room:
                        lists = _lists_by_key(*found, None)
                        launch(blend.compose, pixels, [lists.ranges, lists.splats, centre, conic, *rest, *result], device)
                    _set_room(size, total)
        alphas = 1 - clear
        if lists.broken is not None:
            image = torch.where(lists.broken, torch.nan, image)
        ctx.sizes = (side, strides, width, height, columns, tiles)
        ctx.save_for_backward(
            means, covariances, opacities, colours, viewmats, Ks, centre, conic, box, lists.ranges, lists.splats, clear, last
        )
        return image, alphas

    @staticmethod
    @once_differentiable
    def backward(ctx, a_image, a_alpha):
        if hasattr(ctx, "shapes"):
            return *(a_image.new_zeros(shape) for shape in ctx.shapes), *[None] * 8
        means, covariances, opacities, colours, viewmats, Ks, centre, conic, box, ranges, splats, clear, last = ctx.saved_tensors
        side, strides, width, height, columns, tiles = ctx.sizes
        frames, count = means.shape[:2]
        views, device = len(viewmats), means.device
        images = frames * views
        wanted = ctx.needs_input_grad[2:4]
        kernels, blend = build(real_of(means.dtype), side), compose_kernels.build(real_of(means.dtype), side, any(wanted))
        rows = torch.zeros(images * count * ROWS, 4, dtype=means.dtype, device=device)
        a_means, a_covariances = torch.empty_like(means), torch.empty_like(covariances)
        a_image = a_image.contiguous()
        with torch_stream(device):
            tables = [ranges, splats, centre, conic]
            rest = [colours.view(-1, 3), *strides, count, views, width, height, columns, tiles]
            behind = -a_alpha * clear
            if one_thread_per_tile(device):
                given = [clear.clone().view(-1), last.view(-1), a_image.view(-1, 3), behind.view(-1), rows]
                launch(blend.compose_tile_adjoint, images * tiles, [*tables, box, *rest, *given], device)
            else:
                given = [clear.view(-1), last.view(-1), a_image.view(-1, 3), behind.view(-1), rows]
                launch(blend.compose_adjoint, images * tiles * side * side, [*tables, *rest, *given], device)
            given = [means.view(-1, 3), covariances.view(-1, 3, 3), viewmats, Ks, count, width, height, centre, conic, rows]
            launch(kernels.project_adjoint, frames * count, [*given, a_means.view(-1, 3), a_covariances.view(-1, 3, 3)], device)
        rows = rows.view(frames, views, count, ROWS, 4)
        a_opacities = rows[..., 1, 1].sum(1).sum_to_size(opacities.shape) if wanted[0] else None
        a_colours = rows[..., 2, :3].sum_to_size(colours.shape) if wanted[1] else None
        return a_means, a_covariances, a_opacities, a_colours, *[None] * 8
