"""Entry point of `neuido undeclared`. This module does not load torch, so that `--help` stays fast."""

from pathlib import Path

from neuido.data.undeclared.case import Case


def make_undeclared(
    seed: int,
    out: str,
    *,
    case: Case = Case(),  # noqa: B008 (frozen)
    device: str = "auto",
    progress: bool = True,
) -> Path:
    """Generate a folder of measured data whose declared model may lack an effect, and a key that names the effect.

    The key is `<out>/../keys/<name>.yaml`; the README of the folder has its SHA-256. `neuido diagnose` does not read the key. On the CPU,
    the same seed and options give identical files.

    Args:
        seed: Seed of all random choices.
        out: The folder to create; its name is the name of the case.
        case: Fixed properties of the case; the others are drawn at random.
        device: auto, cpu or cuda.
        progress: Show a progress bar.

    Returns:
        The path of the key.

    Raises:
        UserError: An option is unknown or does not suit the others, or `out` exists and is another case.
    """
    from neuido.data.undeclared.sealed_folder import make_sealed_case

    return make_sealed_case(seed, out, case=case, device=device, progress=progress)
