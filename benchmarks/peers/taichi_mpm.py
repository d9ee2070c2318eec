"""Adapter of a differentiable kernel in Taichi, written in the manner of DiffTaichi's `diffmpm3d`: generated adjoints, one grid."""

import numpy as np
import taichi as ti

from peers import Problem


@ti.data_oriented
class TaichiMpm:
    """MLS-MPM with quadratic weights; the backward pass computes the grid of each substep again.

    Args:
        problem: The problem.
        device: `cpu` or `cuda`.
    """

    differs = "kernel by us after DiffTaichi's diffmpm3d; no gradient of the modulus"

    def __init__(self, problem: Problem, device: str) -> None:
        if problem.law != "neo-hookean":
            raise NotImplementedError("this kernel has no networks")
        ti.init(arch=ti.cuda if device == "cuda" else ti.cpu, default_fp=ti.f32, cpu_max_num_threads=1, log_level=ti.ERROR)
        self.problem, self.n, self.dx = problem, problem.count, 1.0 / problem.side
        self.mu = problem.young / (2 * (1 + problem.poisson))
        self.la = problem.young * problem.poisson / ((1 + problem.poisson) * (1 - 2 * problem.poisson))
        self.mass, self.volume, self.dt = problem.density * problem.volume, problem.volume, problem.dt
        rows = (problem.substeps + 1, self.n)
        self.x, self.v = (ti.Vector.field(3, ti.f32, shape=rows, needs_grad=True) for _ in range(2))
        self.C, self.F = (ti.Matrix.field(3, 3, ti.f32, shape=rows, needs_grad=True) for _ in range(2))
        nodes = (problem.side,) * 3
        self.momentum, self.out = (ti.Vector.field(3, ti.f32, shape=nodes, needs_grad=True) for _ in range(2))
        self.weight_sum = ti.field(ti.f32, shape=nodes, needs_grad=True)
        self.at, self.speed, self.weight = (t.astype(np.float32) for t in problem.arrays())
        self.x0, self.v0, self.w = (ti.Vector.field(3, ti.f32, shape=self.n) for _ in range(3))
        for field, given in ((self.x0, self.at), (self.v0, self.speed), (self.w, self.weight)):
            field.from_numpy(given)

    @ti.kernel
    def begin(self):
        for p in range(self.n):
            self.x[0, p] = self.x0[p]
            self.v[0, p] = self.v0[p]
            self.C[0, p] = ti.Matrix.zero(ti.f32, 3, 3)
            self.F[0, p] = ti.Matrix.identity(ti.f32, 3)

    @ti.kernel
    def clear(self):
        for i in ti.grouped(self.weight_sum):
            self.momentum[i] = ti.Vector.zero(ti.f32, 3)
            self.out[i] = ti.Vector.zero(ti.f32, 3)
            self.weight_sum[i] = 0.0
            self.momentum.grad[i] = ti.Vector.zero(ti.f32, 3)
            self.out.grad[i] = ti.Vector.zero(ti.f32, 3)
            self.weight_sum.grad[i] = 0.0

    @ti.kernel
    def clear_slopes(self):
        for s, p in self.x:
            self.x.grad[s, p] = ti.Vector.zero(ti.f32, 3)
            self.v.grad[s, p] = ti.Vector.zero(ti.f32, 3)
            self.C.grad[s, p] = ti.Matrix.zero(ti.f32, 3, 3)
            self.F.grad[s, p] = ti.Matrix.zero(ti.f32, 3, 3)

    @ti.kernel
    def end(self, s: ti.i32):
        for p in range(self.n):
            self.x.grad[s, p] = self.w[p]

    @ti.kernel
    def p2g(self, s: ti.i32):
        for p in range(self.n):
            base = ti.cast(self.x[s, p] / self.dx - 0.5, ti.i32)
            f = self.x[s, p] / self.dx - ti.cast(base, ti.f32)
            w = [0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2]
            F = self.F[s, p]
            identity = ti.Matrix.identity(ti.f32, 3)
            tau = self.mu * (F @ F.transpose() - identity) + self.la * ti.log(F.determinant()) * identity
            affine = self.mass * self.C[s, p] - (self.dt * self.volume * 4.0 / (self.dx * self.dx)) * tau
            for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
                offset = ti.Vector([i, j, k])
                d = (ti.cast(offset, ti.f32) - f) * self.dx
                part = w[i][0] * w[j][1] * w[k][2]
                self.momentum[base + offset] += part * (self.mass * self.v[s, p] + affine @ d)
                self.weight_sum[base + offset] += part * self.mass

    @ti.kernel
    def nodes(self):
        for i in ti.grouped(self.weight_sum):
            if self.weight_sum[i] > 0.0:
                self.out[i] = self.momentum[i] / self.weight_sum[i] + self.dt * ti.Vector([0.0, -9.8, 0.0])

    @ti.kernel
    def g2p(self, s: ti.i32):
        for p in range(self.n):
            base = ti.cast(self.x[s, p] / self.dx - 0.5, ti.i32)
            f = self.x[s, p] / self.dx - ti.cast(base, ti.f32)
            w = [0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2]
            v = ti.Vector.zero(ti.f32, 3)
            C = ti.Matrix.zero(ti.f32, 3, 3)
            for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
                offset = ti.Vector([i, j, k])
                d = (ti.cast(offset, ti.f32) - f) * self.dx
                part = w[i][0] * w[j][1] * w[k][2] * self.out[base + offset]
                v += part
                C += 4.0 / (self.dx * self.dx) * part.outer_product(d)
            self.v[s + 1, p] = v
            self.x[s + 1, p] = self.x[s, p] + self.dt * v
            self.C[s + 1, p] = C
            self.F[s + 1, p] = (ti.Matrix.identity(ti.f32, 3) + self.dt * C) @ self.F[s, p]

    def version(self) -> str:
        """Return the version of the code."""
        return ".".join(map(str, ti.__version__))

    def forward(self) -> None:
        """Move the body."""
        self.begin()
        for s in range(self.problem.substeps):
            self.clear()
            self.p2g(s)
            self.nodes()
            self.g2p(s)

    def gradient(self) -> None:
        """Differentiate the loss with respect to the initial state."""
        self.forward()
        self.clear_slopes()
        self.end(self.problem.substeps)
        for s in reversed(range(self.problem.substeps)):
            self.clear()
            self.p2g(s)
            self.nodes()
            self.g2p.grad(s)
            self.nodes.grad()
            self.p2g.grad(s)

    def wait(self) -> None:
        """Wait for the device."""
        ti.sync()

    def positions(self) -> np.ndarray:
        """Return the last positions [m]."""
        return self.x.to_numpy()[-1]

    def slopes(self) -> np.ndarray:
        """Return the gradient with respect to the initial velocities."""
        return self.v.grad.to_numpy()[0]
