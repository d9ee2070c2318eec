"""The `diagnose` command: its options, and what it prints."""

from neuido.commands.engines.outcome import Share
from neuido.data.files.renamed_options import renamed_arguments
from neuido.errors import UserError


@renamed_arguments(most="max_effects")
def diagnose(
    folder: list[str] | str,
    *,
    out: str,
    model: str | None = None,
    law: str | None = None,
    data: str = "auto",
    effects: str | None = None,
    solver: str = "both",
    draws: int = 199,
    seed: int = 0,
    max_effects: int = 3,
    effort: str = "normal",
    minutes: float = 15.0,
    device: str = "auto",
    resume: bool = True,
    progress: bool = True,
    engine: str = "local",
    address: str | None = None,
    cpus: float = 1.0,
    gpus: float = 0.0,
) -> int:
    """Find the physical effect that a declared model lacks, from measured motion; add it and report the error before and after.

    The answer, in plain words, is an effect, a class of effects that the data cannot tell apart, none, unknown, insufficient, or unfinished
    where the search ended early. The same command given again continues an interrupted run.

    Several folders, or one with options of an engine, are diagnosed as tasks side by side, on this machine or on many (Ray). The results
    of each are in OUT/<its name>, and OUT/diagnoses.csv lists all answers. Folders whose answer is there are not diagnosed again.

    Args:
        folder: Measured data: a folder with experiment.yaml, test.yaml, track.yaml or plane.yaml, or several of them. With an engine,
            an address that fsspec knows (s3://bucket/folder) is one too.
        out: Folder to write: diagnosis.json, report.html, model_after.yaml, trace.json, log.csv and the predicted motion. Of several
            folders it may be such an address.
        model: File with a model in place of the folder's own, for example an earlier model_after.yaml.
        law: Neural law of `neuido predict` in place of the folder's elasticity and plasticity; a factor on its stress is fitted.
        data: Of an experiment: points (tracked ones), video (silhouettes), or auto: points where every recording has them.
        effects: Names of the effects to consider, with commas; all that the data could show where absent.
        solver: What may predict the motion of a body: material_points, finite_elements, or both, so that the data choose.
        draws: Draws of the parametric bootstrap; p-values come in steps of 1 / (draws + 1).
        seed: Seed of the draws.
        max_effects: Largest number of effects that may be added, 1 to 3.
        effort: Work of the search for each body: quick, normal or thorough. What was left out is reported, and the same command with more
            effort continues from there. The answer goes by this work, not by how fast the machine is.
        minutes: Time after which the search of each body is stopped; 0: none. The same command with more minutes continues from there.
            On a CPU the time that other processes take does not count.
        device: auto, cpu or cuda.
        resume: Continue from the predictions that an interrupted run left in OUT/.work.
        progress: Show progress: one line on a terminal, otherwise a line every half minute.
        engine: What runs tasks: local (processes of this machine) or ray (a cluster; extra scale).
        address: Ray cluster: HOST:PORT, ray://HOST:PORT or auto. Absent: RAY_ADDRESS, else a cluster of this machine alone.
        cpus: Cores for each task.
        gpus: GPUs for each task, or a fraction of one; 0: it runs on the CPU.

    Returns:
        Exit status: 1 where one of several folders could not be diagnosed.

    Raises:
        UserError: The folder is no measured data in one of the formats, or an option is out of range.
    """
    options = {
        "model": model,
        "law": law,
        "data": data,
        "effects": effects,
        "solver": solver,
        "draws": draws,
        "seed": seed,
        "max_effects": max_effects,
        "effort": effort,
        "minutes": minutes,
        "device": device,
        "resume": resume,
    }
    folders = [folder] if isinstance(folder, str) else folder
    if len(folders) != 1 or (engine, address, cpus, gpus) != ("local", None, 1.0, 0.0):
        from neuido.commands.engines.many_diagnoses import TABLE, diagnose_folders

        if not folders:
            raise UserError("folder: none is given")
        share = Share(cpus, gpus)
        failed = diagnose_folders(
            folders, out, options | {"progress": False}, engine=engine, address=address, share=share, progress=progress
        )
        print(f"results in {out}: {TABLE}, and a folder for each{f'; {failed} of {len(folders)} failed' if failed else ''}")
        return int(failed > 0)

    from neuido.discrepancy import workflow

    found = workflow.diagnose(folders[0], out=out, progress=progress, **options)
    print(found.summary())
    print(f"results in {found.folder}: open report.html, go on with model_after.yaml")
    return 0
