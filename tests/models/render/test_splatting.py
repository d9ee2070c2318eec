"""The splatting kernels against their slow twin, finite differences and closed forms."""

import math

import pytest
import torch

from neuido.errors import UserError
from neuido.models.render import splat_reference, splatting
from neuido.models.render.gaussians import deform, harmonics_of
from neuido.models.render.splatting import Splatting, rasterize, render
from neuido.types import Cameras, Gaussians

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)]


def cameras(width, height, *, views=2, dtype=torch.float64, device="cpu", distance=4.0, zoom=1.0):
    """Views from directions about the origin; principal point off the middle."""
    viewmats, Ks = [], []
    for j in range(views):
        a, b = 0.4 + 2.1 * j, 0.3 - 0.25 * j
        turn = torch.tensor([[math.cos(a), 0, math.sin(a)], [0, 1, 0], [-math.sin(a), 0, math.cos(a)]], dtype=dtype)
        tilt = torch.tensor([[1, 0, 0], [0, math.cos(b), -math.sin(b)], [0, math.sin(b), math.cos(b)]], dtype=dtype)
        view = torch.eye(4, dtype=dtype)
        view[:3, :3] = tilt @ turn
        view[2, 3] = distance
        viewmats.append(view)
        f = zoom * 1.4 * max(width, height)
        Ks.append(torch.tensor([[f, 0, 0.47 * width], [0, 1.1 * f, 0.52 * height], [0, 0, 1]], dtype=dtype))
    return Cameras(torch.stack(viewmats).to(device), torch.stack(Ks).to(device), width, height)


def cloud(count, *, frames=(), size=0.08, spread=1.0, seed=0, dtype=torch.float64, device="cpu", opacity=(0.05, 1.0)):
    """Random anisotropic Gaussians about the origin: means, covariances, opacities, colours."""
    g = torch.Generator().manual_seed(seed)

    def rand(*shape):
        return torch.rand(*shape, generator=g, dtype=torch.float64)

    means = spread * (2 * rand(*frames, count, 3) - 1) * 0.7
    A = size * (2 * rand(*frames, count, 3, 3) - 1)
    opacities = opacity[0] + (opacity[1] - opacity[0]) * rand(count)
    return [t.to(device, dtype) for t in (means, A @ A.mT, opacities, rand(count, 3))]


def both(scene, view, seed=3, **options):
    """Images, alphas and the gradients of a random functional, from the kernels and from the twin."""
    results = []
    for backend in ("warp", "torch"):
        leaves = [t.clone().requires_grad_() for t in scene]
        images, alphas = rasterize(*leaves, *view, backend=backend, **options)
        g = torch.Generator().manual_seed(seed)
        a, b = (torch.randn(t.shape, generator=g, dtype=torch.float64).to(t) for t in (images, alphas))
        grads = torch.autograd.grad((images * a).sum() + (alphas * b).sum(), leaves)
        results.append((images.detach(), alphas.detach(), *grads))
    return results


def relative(a, b):
    return ((a - b).norm() / b.norm().clamp(min=1e-30)).item()


def compare(scene, view, tolerance=1e-8, **options):
    fast, slow = both(scene, view, **options)
    for name, a, b in zip(("images", "alphas", "means", "covariances", "opacities", "colours"), fast, slow, strict=True):
        assert a.shape == b.shape, name
        assert torch.isfinite(a).all(), name
        worst = (a - b).abs().max().item() if a.numel() else 0.0
        assert relative(a, b) < tolerance, f"{name}: relative error {relative(a, b):.1e}, largest difference {worst:.1e}"
    return fast


SCENES = {
    "plain": (cloud(60), cameras(40, 24)),
    "odd size": (cloud(40, seed=1), cameras(37, 19)),
    "one pixel": (cloud(20, seed=2), cameras(1, 1)),
    "behind and beside": (cloud(80, seed=4, spread=6.0), cameras(24, 32)),
    "many and opaque": (cloud(300, seed=5, spread=0.3, opacity=(0.9, 1.0)), cameras(24, 24)),
    "large": (cloud(30, seed=6, size=1.5), cameras(33, 33)),
    "saturated": (cloud(12, seed=23, size=2.0, opacity=(1.0, 1.0)), cameras(33, 33)),  # alpha is clamped near the centres
    "tiny": (cloud(60, seed=7, size=1e-3), cameras(32, 32)),
    "faint": (cloud(60, seed=8, opacity=(0.0, 0.02)), cameras(32, 32)),
    "close": (cloud(60, seed=9, spread=1.5, size=0.2), cameras(32, 32, distance=0.5)),
}


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", SCENES)
def test_kernels_agree_with_the_twin_in_float64(name, device):
    scene, view = SCENES[name]
    scene = [t.to(device) for t in scene]
    compare(scene, Cameras(view.viewmats.to(device), view.Ks.to(device), *view[2:]))


@pytest.mark.parametrize("name", SCENES)
def test_the_kernels_of_cuda_agree_on_the_cpu(name, monkeypatch):
    """One thread a pixel, tiles of 16, keys and a sort."""
    monkeypatch.setattr(splatting, "one_thread_per_tile", lambda device: False)
    monkeypatch.setitem(splatting.TILE, "cpu", 16)
    monkeypatch.setattr(splatting, "_rooms", rooms := {})
    compare(*SCENES[name])
    for key in rooms:  # lists with room for more, and lists that turn out too short and are built again
        for room in (2 * rooms[key] + 5, rooms[key] // 3):
            rooms[key] = room
            compare(*SCENES[name])
            assert rooms[key] != room or not room


@pytest.mark.parametrize("device", DEVICES)
def test_float32_is_tight_but_for_flips(device):
    """At alpha = 1/255 and at transmittance 1e-4 rounding decides: few pixels may jump there, by no more than such a splat shows."""
    scene, view = cloud(400, seed=10, dtype=torch.float32, device=device), cameras(64, 48, dtype=torch.float32, device=device)
    fast = both(scene, view)[0]
    slow = both([t.double() for t in scene], Cameras(view.viewmats.double(), view.Ks.double(), *view[2:]))[1]
    difference = (fast[0] - slow[0]).abs().amax(-1)
    flips = (difference > 1e-4).double().mean().item()
    assert flips < 2e-3, f"{flips:.1e} of the pixels differ by more than 1e-4"
    assert difference.max() < 1.2 / 255, f"the largest difference is {difference.max():.1e}"
    for name, a, b in zip(("means", "covariances", "opacities", "colours"), fast[2:], slow[2:], strict=True):
        a, b = a.reshape(400, -1), b.reshape(400, -1)
        off = ((a - b).norm(dim=1) > 1e-3 * (b.norm(dim=1) + b.norm() / len(b) ** 0.5)).double().mean().item()
        assert off < 0.02, f"{name}: {off:.1%} of the Gaussians have gradients off by more than 1e-3"
        assert relative(a, b) < 2e-2, f"{name}: relative error {relative(a, b):.1e}"


@pytest.mark.parametrize("device", DEVICES)
def test_gradients_in_float32_away_from_the_discontinuities(device):
    """Few Gaussians that nowhere end in the image: nothing can flip."""
    scene, view = cloud(6, seed=11, size=1.2, spread=0.2, device=device, opacity=(0.1, 0.3)), cameras(16, 16, zoom=4.0, device=device)
    fast = both([t.float() for t in scene], Cameras(view.viewmats.float(), view.Ks.float(), *view[2:]))[0]
    slow = both(scene, view)[1]
    for name, a, b in zip(("images", "alphas", "means", "covariances", "opacities", "colours"), fast, slow, strict=True):
        assert relative(a, b) < (1e-5 if name in ("images", "alphas") else 1e-4), f"{name}: {relative(a, b):.1e}"


def test_projection_adjoint_against_finite_differences():
    """In float64, with one Gaussian outside the image where the Jacobian is clamped."""
    scene, view = cloud(3, seed=12, size=0.5, spread=0.3, opacity=(0.5, 0.6)), cameras(12, 12, zoom=3.0)
    scene[0][0] += 1.5 * torch.linalg.inv(view.viewmats[0])[:3, 0] / 3
    scene[1][0] *= 6
    weight = torch.randn(2, 12, 12, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def loss(means, covariances):
        return (rasterize(means, covariances, *scene[2:], *view)[0] * weight).sum()

    leaves = [t.clone().requires_grad_() for t in scene[:2]]
    grads = torch.autograd.grad(loss(*leaves), leaves)
    h = 1e-6
    for which, grad in enumerate(grads):
        for i in range(scene[which].numel()):
            shifted = []
            for sign in (h, -h):
                moved = [t.clone() for t in scene[:2]]
                moved[which].view(-1)[i] += sign
                shifted.append(loss(*moved))
            numeric = ((shifted[0] - shifted[1]) / (2 * h)).item()
            assert grad.reshape(-1)[i].item() == pytest.approx(numeric, rel=1e-5, abs=1e-6 * grad.abs().max().item())


def test_clamp_of_the_jacobian_is_in_force():
    scene, view = cloud(3, seed=12, size=0.5, spread=0.3), cameras(12, 12, zoom=3.0)
    p = torch.tensor([3.0, 0.0, 4.0], dtype=torch.float64)
    eye = torch.eye(4, dtype=torch.float64)
    spreads = [splat_reference.project(p * s, scene[1][0], eye, view.Ks[0], 12, 12, 0.0)[1] * s * s for s in (1.0, 2.0)]
    free = view.Ks[0, 0, 0] / 4 * torch.tensor([1, 0, -0.75], dtype=torch.float64)
    assert torch.allclose(spreads[0], spreads[1])
    assert not torch.allclose(spreads[0][0, 0], free @ scene[1][0] @ free)


@pytest.mark.parametrize("device", DEVICES)
def test_one_gaussian_is_its_closed_form(device):
    """On the optical axis: alpha = opacity exp(-r^2 / 2 s^2) with s^2 = (f sigma / z)^2 + 0.3, cut at 1/255."""
    K = torch.tensor([[[50.0, 0, 16], [0, 50.0, 16], [0, 0, 1]]], dtype=torch.float64, device=device)
    view = torch.eye(4, dtype=torch.float64, device=device)[None]
    mean = torch.tensor([[0.0, 0.0, 2.0]], dtype=torch.float64, device=device)
    covariance = 0.1**2 * torch.eye(3, dtype=torch.float64, device=device)[None]
    opacity, colour = mean.new_tensor([0.7]), mean.new_tensor([[0.2, 0.5, 1.0]])
    images, alphas = rasterize(mean, covariance, opacity, colour, view, K, 32, 32, background=mean.new_tensor([1.0, 0.0, 0.5]))
    at = torch.arange(32, dtype=torch.float64, device=device) + 0.5 - 16
    alpha = 0.7 * torch.exp(-(at[:, None] ** 2 + at**2) / (2 * ((50 * 0.1 / 2) ** 2 + 0.3)))
    alpha = torch.where(alpha >= 1 / 255, alpha, 0)
    assert torch.allclose(alphas[0], alpha, atol=1e-12)
    expected = alpha[..., None] * colour[0] + (1 - alpha)[..., None] * mean.new_tensor([1.0, 0.0, 0.5])
    assert torch.allclose(images[0], expected, atol=1e-12)


def test_nearer_gaussians_hide_farther_ones_until_the_pixel_is_finished():
    """On the axis of a pixel alpha is the opacity: shares 0.8, 0.2 x 0.9, 0.02 x 0.99; the fourth would leave less than 1e-4."""
    K = torch.tensor([[[50.0, 0, 8.5], [0, 50.0, 8.5], [0, 0, 1]]])
    means = torch.tensor([[0.0, 0.0, 3.0], [0.0, 0.0, 2.0], [0.0, 0.0, 4.0], [0.0, 0.0, 5.0]])
    opacities, colours = torch.tensor([0.9, 0.8, 0.99, 1.0]), torch.cat([torch.eye(3), torch.ones(1, 3)])
    images, alphas = rasterize(means, torch.eye(3).expand(4, 3, 3) * 0.25, opacities, colours, torch.eye(4)[None], K, 17, 17)
    assert images[0, 8, 8].tolist() == pytest.approx([0.18, 0.8, 0.0198], abs=1e-6)
    assert alphas[0, 8, 8].item() == pytest.approx(0.9998, abs=1e-6)


@pytest.mark.parametrize("device", DEVICES)
def test_batch_equals_single_calls(device):
    frames, view = (2, 3), cameras(36, 20, views=3, device=device)
    scene = cloud(50, frames=frames, seed=13, device=device)
    fast = compare(scene, view)
    assert fast[0].shape == (2, 3, 3, 20, 36, 3)
    for i in range(2):
        for j in range(3):
            for v in range(3):
                one = rasterize(scene[0][i, j], scene[1][i, j], *scene[2:], view.viewmats[v : v + 1], view.Ks[v : v + 1], 36, 20)
                assert torch.equal(one[0][0], fast[0][i, j, v])
                assert torch.equal(one[1][0], fast[1][i, j, v])


def test_cameras_that_move_show_each_frame_from_its_pose():
    means, covariances, opacities, colours = cloud(30, frames=(3,))
    still = [cameras(24, 16, distance=4.0 + 0.5 * t) for t in range(4)]
    moving = still[0]._replace(viewmats=torch.stack([each.viewmats for each in still], 1))
    images, alphas = rasterize(means, covariances, opacities, colours, *moving, background=torch.ones(3))
    for t in range(3):  # the fourth pose is that of a frame that is not drawn
        wanted = rasterize(means[t], covariances[t], opacities, colours, *still[t], background=torch.ones(3))
        assert torch.equal(images[t], wanted[0]) and torch.equal(alphas[t], wanted[1])
    with pytest.raises(UserError, match=r"at most 4 frames, for which the cameras have a pose"):
        rasterize(means[0], covariances[0], opacities, colours, *moving)


@pytest.mark.parametrize("device", DEVICES)
def test_opacities_and_colours_of_each_frame(device):
    scene = cloud(30, frames=(3,), seed=14, device=device)
    g = torch.Generator().manual_seed(1)
    scene[2:] = [torch.rand(3, 30, generator=g).double().to(device), torch.rand(3, 30, 3, generator=g).double().to(device)]
    compare(scene, cameras(24, 24, device=device))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_harmonics_and_rotations_carry_gradients(degree, device):
    scene = cloud(30, frames=(2,), seed=15, device=device)
    g = torch.Generator().manual_seed(2)
    scene[3] = (0.4 * torch.randn(30, (degree + 1) ** 2, 3, generator=g)).double().to(device)
    compare(scene, cameras(24, 24, device=device), sh_degree=degree)
    turns = torch.linalg.qr(torch.randn(2, 30, 3, 3, generator=g).double()).Q.to(device)
    fast = compare(scene, cameras(24, 24, device=device), sh_degree=degree, rotations=turns)
    plain = rasterize(*scene, *cameras(24, 24, device=device), sh_degree=degree)[0]
    assert torch.equal(plain, fast[0]) == (degree == 0)


def test_a_body_and_a_camera_that_turn_together_leave_the_image_as_it_was():
    """Frame indifference: means, covariances and harmonics all turn with F = Q."""
    scene, view = cloud(40, seed=24), cameras(24, 24)
    g = torch.Generator().manual_seed(4)
    body = Gaussians(*scene[:3], 0.5 * torch.randn(40, 16, 3, generator=g).double())
    Q = torch.linalg.qr(torch.randn(3, 3, generator=g).double()).Q
    Q = Q * torch.linalg.det(Q).sign()
    shift = torch.tensor([0.3, -2.0, 0.7], dtype=torch.float64)
    before = render(body, view)[0]
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3], turn[:3, 3] = Q, shift
    moved = deform(body, Q.expand(40, 3, 3), body.means @ Q.T + shift)
    after = render(moved, view._replace(viewmats=view.viewmats @ torch.linalg.inv(turn)))[0]
    assert torch.allclose(after, before, atol=1e-10)
    assert (
        render(moved._replace(rotations=None), view._replace(viewmats=view.viewmats @ torch.linalg.inv(turn)))[0] - before
    ).abs().max() > 0.1


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("count", [0, 5])
def test_an_empty_view_shows_the_background_and_has_zero_gradients(count, device):
    scene, view = cloud(count, device=device), cameras(20, 12, device=device)
    scene[0] = (scene[0] + 100).requires_grad_()
    images, alphas = rasterize(*scene, *view, background=torch.tensor([0.1, 0.2, 0.3], device=device))
    assert (alphas == 0).all()
    assert torch.allclose(images, images.new_tensor([0.1, 0.2, 0.3]).expand_as(images), atol=1e-7)
    assert (torch.autograd.grad(images.sum(), scene[0])[0] == 0).all()


def test_near_and_far_cut_at_the_centre():
    view = cameras(16, 16, views=1)
    scene = cloud(40, seed=16)
    depth = (scene[0] @ view.viewmats[0, :3, :3].T + view.viewmats[0, :3, 3])[:, 2]
    kept = (depth >= 3.8) & (depth <= 4.3)
    assert 0 < kept.sum() < 40
    cut = rasterize(*scene, *view, near=3.8, far=4.3)
    alone = rasterize(*(t[kept] for t in scene), *view)
    assert torch.equal(cut[0], alone[0])


def test_equal_depths_keep_the_order_of_the_indices():
    scene, view = cloud(12, seed=17, size=0.4), cameras(16, 16, views=1)
    scene[0][:] = scene[0][:1]
    compare(scene, view)


@pytest.mark.parametrize("device", DEVICES)
def test_only_wanted_gradients_are_computed(device):
    scene, view = cloud(40, seed=18, device=device), cameras(24, 24, device=device)
    full = both(scene, view)[0]
    leaves = [t.clone().requires_grad_(i < 2) for i, t in enumerate(scene)]
    images, alphas = rasterize(*leaves, *view)
    g = torch.Generator().manual_seed(3)
    a, b = (torch.randn(t.shape, generator=g, dtype=torch.float64).to(t) for t in (images, alphas))
    grads = torch.autograd.grad((images * a).sum() + (alphas * b).sum(), leaves[:2])
    for mine, other in zip(grads, full[2:4]):
        assert torch.allclose(mine, other, rtol=1e-10, atol=1e-12 * other.abs().max().item())


def test_both_ways_to_list_the_tiles_agree():
    """The keys and the sort of CUDA, run on the CPU, give the lists of the counting sort less the tiles that an ellipse does not meet."""
    scene, view = cloud(200, seed=19, dtype=torch.float32), cameras(50, 30, dtype=torch.float32)
    kernels = splatting.build(splatting.real_of(torch.float32), 8)
    splat, depth, status = project(kernels, scene, view)
    columns, tiles = 7, 28
    counted = splatting._lists_by_counting(kernels, splat, depth, status, columns, tiles)
    keyed = splatting._lists_by_key(kernels, splat, depth, status, columns, tiles, None)
    assert 0.7 * len(counted.splats) < len(keyed.splats) < len(counted.splats)
    for (i, j), (k, l) in zip(counted.ranges.tolist(), keyed.ranges.tolist(), strict=True):
        few = keyed.splats[k:l].tolist()
        assert [g for g in counted.splats[i:j].tolist() if g in set(few)] == few
    roomy = splatting._lists_by_key(kernels, splat, depth, status, columns, tiles, 2 * len(keyed.splats))
    assert torch.equal(roomy.ranges, keyed.ranges)
    assert not roomy.broken
    assert splatting._lists_by_key(kernels, splat, depth, status, columns, tiles, len(keyed.splats) - 1).broken


def project(kernels, scene, view):
    means, covariances, opacities, _ = scene
    count, images = len(means), len(view.viewmats)
    centre, conic = torch.empty(images * count, 4), torch.empty(images * count, 3)
    box, depth, status = torch.empty(images * count, 4, dtype=torch.int32), torch.empty(images, count), torch.zeros(1, dtype=torch.int32)
    inputs = [means, covariances, opacities, 0, view.viewmats, view.Ks, count, view.width, view.height, 0.01, 1e10, 0.3]
    splatting.launch(kernels.project, images * count, [*inputs, centre, conic, box, depth.view(-1), status], means.device)
    return (centre, conic, box), depth, status


@pytest.mark.gpu
def test_capacity_needs_no_round_trip_and_marks_an_overflow():
    scene = cloud(100, seed=20, dtype=torch.float32, device="cuda")
    view = cameras(48, 48, dtype=torch.float32, device="cuda")
    plain = rasterize(*scene, *view)[0]
    rasterize(*scene, *view, capacity=20000)
    graph, means = torch.cuda.CUDAGraph(), scene[0].clone()
    with torch.cuda.graph(graph):
        captured = rasterize(means, *scene[1:], *view, capacity=20000)[0]
    graph.replay()
    assert torch.equal(captured, plain)
    means += 0.1
    graph.replay()
    assert torch.equal(captured, rasterize(means, *scene[1:], *view)[0])
    assert rasterize(*scene, *view, capacity=10)[0].isnan().all()


@pytest.mark.gpu
def test_gsplat_agrees():
    gsplat = pytest.importorskip("gsplat")
    if gsplat.cuda._backend._C is None:
        pytest.skip("gsplat is installed but its CUDA part is not built")
    scene = cloud(400, seed=21, dtype=torch.float32, device="cuda")
    view = cameras(64, 48, dtype=torch.float32, device="cuda")
    results = []
    for backend in ("warp", "gsplat"):
        leaves = [t.clone().requires_grad_() for t in scene]
        images, alphas = rasterize(*leaves, *view, backend=backend)
        results.append((images, alphas, *torch.autograd.grad(images.square().sum() + alphas.sum(), leaves)))
    for name, a, b in zip(("images", "alphas", "means", "covariances", "opacities", "colours"), *results, strict=True):
        print(f"{name}: relative difference from gsplat {relative(a, b):.1e}")
        assert relative(a, b) < (1e-3 if name in ("images", "alphas") else 1e-2), name


def test_module_keeps_its_options():
    scene, view = cloud(20, seed=22, dtype=torch.float32), cameras(16, 16, dtype=torch.float32)
    gaussians = Gaussians(*scene[:3], harmonics_of(scene[3]))
    images, alphas = Splatting(background=(1.0, 1.0, 1.0))(gaussians, view)
    expected = rasterize(*scene, *view, background=torch.ones(3))[0]
    assert torch.allclose(images, expected, atol=1e-6)
    assert torch.equal(render(gaussians, view, eps2d=0.3)[1], alphas)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"backend": "cuda"}, "backend is 'cuda'"),
        ({"width": 0}, "width and height are 0 and 16"),
        ({"opacities": torch.ones(3)}, r"opacities have shape \(3,\); needed \(10,\)"),
        ({"covariances": torch.ones(10, 3)}, "covariances have shape"),
        ({"colours": torch.ones(4, 10, 3)}, "colours have shape"),
        ({"means": torch.full((10, 3), math.nan)}, "20 projected Gaussians have numbers that are not finite"),
        ({"sh_degree": 1}, r"harmonics have shape \(10, 3\)"),
    ],
)
def test_errors_name_what_is_wrong(change, message):
    names = ("means", "covariances", "opacities", "colours", "viewmats", "Ks", "width", "height")
    arguments = dict(zip(names, (*cloud(10, dtype=torch.float32), *cameras(16, 16, dtype=torch.float32)))) | change
    with pytest.raises(UserError, match=message):
        rasterize(**arguments)


def test_gsplat_that_is_missing_is_named():
    try:
        import gsplat  # noqa: F401
    except ImportError:
        with pytest.raises(UserError, match="'gsplat' is not installed"):
            rasterize(*cloud(5), *cameras(8, 8), backend="gsplat")
