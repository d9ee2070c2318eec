"""The `demo` command: laws learned from simulated bodies, a law read from video, one closed loop, and a page that shows them."""

import base64
import os
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuido.data.files.html_page import escaped, page, picture, table
from neuido.data.files.output_folder import claimed_folder
from neuido.errors import UserError

if TYPE_CHECKING:
    from neuido.commands.demo.closed_loop import LoopResult
    from neuido.commands.demo.filmed_duck import Reading
    from neuido.commands.demo.law_from_video import Adapted, VideoResult
    from neuido.commands.demo.learned_laws import LawsResult

PARTS = ("reading", "laws", "video", "loop")
MADE = ("reading", "trajectories", "lightning_logs", "csv", "demo.png", "video", "loop", "report.html")
"""What a demonstration leaves in its folder; that of an earlier version has no demo.json."""


def demo(*, out: str = "runs/demo", settings: str = "quickstart", parts: str = "reading,laws,video,loop") -> None:
    """Learn laws from simulated bodies, read a law from video, and find an effect that a model lacks; minutes on a CPU.

    Four parts: `reading` films a rubber duck and reads its stiffness in one pass of the shipped encoder; `laws` trains the operator on
    small trajectories and compares the motion under its laws with the true one (Stage I); `video` films small bodies, trains Stage II on
    two of them and reads the law of a third in one pass; `loop` diagnoses a small experiment whose model lacks an effect. Writes tables,
    pictures and one page, <out>/report.html.

    Args:
        out: Folder for runs, pictures and the page.
        settings: Configuration of Stage I.
        parts: Which parts to run, with commas.

    Raises:
        UserError: A part that there is not.
    """
    chosen = [part.strip() for part in parts.split(",") if part.strip()]
    for part in chosen:
        if part not in PARTS:
            raise UserError(f"parts = {parts}: {part!r} is not known; choose from {', '.join(PARTS)}")
    if not chosen:
        raise UserError(f"parts = {parts!r} names none: choose from {', '.join(PARTS)}")

    from neuido.commands.cli.config_files import find_config
    from neuido.physics.runtime.threads import one_thread_each

    find_config(settings, "--settings")
    folder, sections = Path(out), []
    with claimed_folder(folder, {"settings": settings}, "a demonstration with other settings", file="demo.json", keeps=MADE):
        with one_thread_each():
            for part in (part for part in PARTS if part in chosen):
                begun = time.monotonic()
                body = {"reading": _reading, "laws": _laws, "video": _video, "loop": _loop}[part](folder, settings)
                spent = time.monotonic() - begun
                print(f"{part}: {spent:.0f} s\n", flush=True)
                sections.append(f'{body}<p class="note">{spent:.0f} s.</p>')
        target = folder / "report.html"
        _write(target, "\n".join(sections))
        print(f"results in {folder}: open {target}")


def _reading(folder: Path, settings: str) -> str:
    from neuido.commands.demo.filmed_duck import demo_reading

    return reading_section(demo_reading(str(folder / "reading")))


def _laws(folder: Path, settings: str) -> str:
    from neuido.commands.demo.learned_laws import demo_laws

    return laws_section(demo_laws(str(folder), settings=settings))


def _video(folder: Path, settings: str) -> str:
    from neuido.commands.demo.law_from_video import demo_video

    return video_section(demo_video(str(folder / "video")))


def _loop(folder: Path, settings: str) -> str:
    from neuido.commands.demo.closed_loop import demo_loop

    return loop_section(demo_loop(str(folder / "loop")), folder)


def reading_section(result: "Reading") -> str:
    """Format the law that was read of the duck as HTML, with its video."""
    rows = [
        ("Young's modulus that was read [kPa]", result.young / 1e3),
        ("its 90 % interval [kPa]", f"{result.low / 1e3:.3g} to {result.high / 1e3:.3g}"),
        ("true, not told [kPa]", result.true / 1e3),
        ("particles from the true motion, RMS [mm]", 1e3 * result.rmse),
        ("from images to law [s]", result.seconds),
    ]
    text = "A rubber duck falls before two cameras. One pass of the encoder reads its law, and a simulation with this law is filmed again."
    source = f"data:video/mp4;base64,{base64.b64encode(result.video.read_bytes()).decode()}"
    shown = f'<video controls loop muted playsinline style="max-width:100%" src="{source}"></video>'
    return f"<h2>A law read from a film</h2><p>{text}</p>{table(('', ''), rows, digits=3)}{shown}{picture(result.picture)}"


def laws_section(result: "LawsResult") -> str:
    """Format the section on learned laws (Stage I) of the demo page as HTML."""
    head = ("material", "stress error", "plastic error", "particle RMSE [m]", "RMSE over path")
    text = (
        "Trained on a thrown cube, tried on a falling ball: relative errors of the stress and of the plastic correction, held out "
        "(a material that does not flow has no plastic error), and the distance of matched particles from the motion under the true law."
    )
    return f"<h2>Stage I: laws from simulated bodies</h2><p>{text}</p>{table(head, result.rows, digits=3)}{picture(result.picture)}"


def video_section(result: "VideoResult") -> str:
    """Stage II and zero-shot on the page: figures, and predicted against recorded frames."""
    keys = [key for key in ("cd", "floor", "rmse", "psnr", "ssim") if any(key in scene.scores for scene in result.scenes)]
    units = {"cd": "CD [1e-4]", "floor": "its floor [1e-4]", "rmse": "particle RMSE [m]", "psnr": "PSNR [dB]", "ssim": "SSIM"}
    rows = [
        (scene.name, "unseen" if scene.unseen else "trained on", f"{1e3 * scene.seconds:.1f} ms", *(scene.scores.get(k, "") for k in keys))
        for scene in result.scenes
    ]
    head = ("scene", "", "inference", *(units[key] for key in keys))
    half = len(result.losses) // 2
    text = "Inference: one pass from flow latents to the law. Scores are those of views that were held out."
    if half:
        first, second = (sum(part) / len(part) for part in (result.losses[:half], result.losses[half:]))
        steps = f"{len(result.losses)} steps of Stage II on whole recordings"
        text = f"The image loss of {steps}: {first:.3g} on average in the first half, {second:.3g} in the second. {text}"
    few = "" if result.adapted is None else adapted_section(result.adapted)
    shown = "".join(f"<h3>{escaped(s.name)}: recorded above, predicted below</h3>{picture(s.picture)}" for s in result.scenes)
    return f"<h2>Stage II: a law from video, in one pass</h2><p>{text}</p>{table(head, rows, digits=3)}{shown}{few}"


def adapted_section(result: "Adapted") -> str:
    """Few-shot adaptation on the page: scores on the held-out view before and after."""
    rows = [(name, scores.get("psnr", ""), scores.get("cd", ""), scores.get("rmse", "")) for name, scores in
            (("zero-shot", result.before), (f"after {result.steps} steps, {result.seconds:.0f} s", result.after))]  # fmt: skip
    text = "LoRA on both trunks and the latent, fitted to the training views of the scene that Stage II has not seen; scores of the others."
    compared = table(("", "PSNR [dB]", "CD [1e-4]", "particle RMSE [m]"), rows, digits=3)
    return f"<h3>{escaped(result.name)}: adapted to its images</h3><p>{text}</p>{compared}{picture(result.picture)}"


def loop_section(result: "LoopResult", folder: Path) -> str:
    """Write the page's section on the closed loop, with a link to the loop's own report."""
    from neuido.commands.demo.closed_loop import figures

    rows: list[tuple[Any, ...]] = [
        ("what is missing (truth)", figures(result.truth)),
        ("answer", result.words),
        ("its figures", figures(result.parameters)),
        ("held-out error before [mm]", 1e3 * result.before),
        ("held-out error after [mm]", 1e3 * result.after),
        ("floor of noise and discretisation [mm]", 1e3 * result.floor),
    ]
    if result.again:
        rows.append(("answer once the effect is in the model", result.again))
    link = escaped(Path(os.path.relpath(result.report, folder)).as_posix())
    text = (
        "A block is thrown twice; its declared model lacks an effect. The residual of the best fit (arrows, at each point) is "
        f'traced to it. <a href="{link}">The whole diagnosis</a>.'
    )
    head = "<h2>The closed loop: what does the model lack?</h2>"
    return f"{head}<p>{text}</p>{table(('', ''), rows, digits=3)}{picture(result.picture)}"


def _write(path: Path, body: str) -> None:
    from neuido.data.files.writing import write_text

    write_text(path, page("neuido demo", f"<h1>neuido demo</h1>\n{body}"))
