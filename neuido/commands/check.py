"""The `check` command: whether measured data are plausible, and whether a recording of images is good enough to learn from."""

import warnings
from pathlib import Path

from neuido.errors import PlausibilityWarning, UserError

KINDS = ("experiment.yaml", "test.yaml", "track.yaml", "plane.yaml")


def check(folder: str) -> None:
    """Read measured data or a recording of images and say whether they are plausible: units, times, markers; views, blur, masks.

    Args:
        folder: A folder with experiment.yaml, test.yaml, track.yaml or plane.yaml, or a recording of images.

    Raises:
        UserError: What is wrong, with the file and the key to change.
    """
    given = Path(folder).expanduser()
    if given.is_dir() and not any((given / name).is_file() for name in KINDS):
        check_capture(given)
        return
    with warnings.catch_warnings(record=True) as odd:
        warnings.simplefilter("always", PlausibilityWarning)
        lines = contents(folder)
    print("\n".join(lines))
    for each in odd:
        print(f"  odd: {each.message}")
    if odd:
        print(f"{len(odd)} odd {'thing' if len(odd) == 1 else 'things'}, otherwise", end=" ")
    print(f"plausible: `neuido diagnose {folder} --out FOLDER` goes on with it")


def check_capture(folder: Path) -> None:
    """Print what is wrong with a recording of images and what could be better, before any training.

    Raises:
        UserError: The recording cannot be read, or something must be mended.
    """
    from neuido.data.scenes.capture_quality import capture_findings
    from neuido.data.scenes.readers import MARKS, read_recording

    if not any((folder / mark).exists() for marks in MARKS.values() for mark in marks):
        raise UserError(f"{folder} has none of {', '.join(KINDS)} and is no recording of images: `neuido import` makes such a folder")
    found = read_recording(folder)
    print(f"{found.format} recording {found.name}, {len(found.views)} views, {len(found.times)} frames")
    findings = capture_findings(found)
    for finding in findings:
        print(f"  {finding}")
    if wrong := sum(finding.wrong for finding in findings):
        raise UserError(f"{folder} has {wrong} thing{'s' * (wrong > 1)} to mend before training: see the capture guide")
    print(f"good enough: `neuido reconstruct {folder}` goes on with it")


def contents(folder: str) -> list[str]:
    """Return what measured data hold, a line a recording or a test.

    Args:
        folder: A folder with experiment.yaml, test.yaml, track.yaml or plane.yaml.

    Raises:
        UserError: What cannot be read, or is not plausible.
    """
    given = Path(folder).expanduser()
    here = given.name if given.is_file() else next((name for name in KINDS if (given / name).is_file()), "")
    if here == "experiment.yaml":
        from neuido.data.measured.experiment import read_experiment

        found = read_experiment(given)
        kind, entries = "experiment", found.recordings
    elif here == "test.yaml":
        from neuido.data.measured.material_test import read_material_tests

        found = read_material_tests(given)
        kind, entries = "material test", found.tests
    elif here == "track.yaml":
        from neuido.data.measured.track import read_tracks

        found = read_tracks(given)
        kind, entries = "track", found.recordings
    elif here == "plane.yaml":
        from neuido.data.measured.plane_experiment import read_plane_experiment

        found = read_plane_experiment(given)
        kind, entries = "plane specimen", found.recordings
    else:
        raise UserError(f"{folder} has none of {', '.join(KINDS)}: `neuido import` makes such a folder")
    count = f"{len(entries)} recording{'s' * (len(entries) > 1)}"
    return [f"{kind} {found.name}, {count}", *(f"  {entry.name}: {ROLES[entry.role]}" for entry in entries)]


ROLES = {"fit": "to fit", "held_out": "held out, for scores alone"}
