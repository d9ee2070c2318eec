"""The `undeclared` command: a folder to diagnose whose answer is sealed. `--help` loads no torch."""

from pathlib import Path

from neuido.commands.check import contents
from neuido.data.files.writing import check_writable
from neuido.data.undeclared import Case, make_undeclared


def undeclared(
    out: str,
    *,
    seed: int,
    measured: str = "body",
    kind: str | None = None,
    solver: str | None = None,
    nuisances: bool | None = None,
    separation: float | None = None,
    particles: int = 0,
    seconds: float = 0.0,
    device: str = "auto",
    progress: bool = True,
) -> None:
    """Make measured data whose declared model lacks an effect, or nothing, and seal the answer: an exercise for `neuido diagnose`.

    The answer, the key, is in ../keys beside the folder; the folder's README has its SHA-256. On the CPU the same seed and options give
    the same folder, byte for byte.

    Args:
        out: Folder to write; its name is the name of the case.
        seed: Seed of everything that is drawn.
        measured: body (an experiment), driven (a bar pulled by a clamp, with its forces), material_test, track or guided.
        kind: The effect that is not declared: one of the vocabulary, one outside it, `none`, or two joined by a plus sign; drawn
            where absent, as all that follows.
        solver: Of a body: same (the grid and step that the folder suggests), finer (36 to 44 cells, half the step) or elements
            (finite elements).
        nuisances: Whether clock, latency, ruler, launch speed and spin of a body are off by one to two standard deviations; drawn
            for a case without an effect, else no.
        separation: How far the effect moves the recorded points, in standard deviations of the noise.
        particles: About how many particles a body has; 0: 1500 to 3000.
        seconds: Length of a body's recordings, s; 0: 0.4 to 0.6.
        device: auto, cpu or cuda.
        progress: Show a progress bar.

    Raises:
        UserError: An unknown kind or option, a kind that does not fit the others, or a folder that holds something else.
    """
    check_writable(Path(out))
    case = Case(measured, kind, solver, nuisances, separation, particles, seconds)
    key = make_undeclared(seed, out, case=case, device=device, progress=progress)
    print("\n".join(contents(out)))
    print(f"the sealed answer is {key}")
    print(f"results in {out}: `neuido diagnose {out} --out FOLDER` looks for what its model lacks")
