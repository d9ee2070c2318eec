"""The entry to the making of undeclared cases. No torch at import, so that `--help` stays light."""

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
    """Make one folder to diagnose, and its key at `<out>/../keys/<name>.yaml`; the folder's README has the key's SHA-256.

    On the CPU the same seed and options give the same folder, byte for byte. Nothing that diagnoses reads the key.

    Args:
        seed: Of everything that is drawn.
        out: The folder to make; its name is the name of the case.
        case: What is not to be drawn.
        device: auto, cpu or cuda.
        progress: Show a progress bar.

    Returns:
        The key.

    Raises:
        UserError: An unknown kind or option, a kind that does not fit the others, or a folder that holds something else.
    """
    from neuido.data.undeclared.sealed_folder import make_sealed_case

    return make_sealed_case(seed, out, case=case, device=device, progress=progress)
