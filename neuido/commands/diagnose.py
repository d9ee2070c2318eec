"""The `diagnose` command: its options, and what it prints."""

from neuido.data.files.renamed_options import renamed_arguments


@renamed_arguments(most="max_effects")
def diagnose(
    folder: str,
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
) -> None:
    """Find the physical effect that a declared model lacks, from measured motion; add it and report the error before and after.

    The answer, in plain words, is an effect, a class of effects that the data cannot tell apart, none, unknown, insufficient, or unfinished
    where the search ended early. The same command given again continues an interrupted run.

    Args:
        folder: Measured data: a folder with experiment.yaml, test.yaml or track.yaml.
        out: Folder to write: diagnosis.json, report.html, model_after.yaml, trace.json, log.csv and the predicted motion.
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
        device: auto, cpu or cuda.
        resume: Continue from the predictions that an interrupted run left in OUT/.work.
        progress: Show progress: one line on a terminal, otherwise a line every half minute.

    Raises:
        UserError: The folder is no measured data in one of the three formats, or an option is out of range.
    """
    from neuido.discrepancy import workflow

    found = workflow.diagnose(
        folder,
        out=out,
        model=model,
        law=law,
        data=data,
        effects=effects,
        solver=solver,
        draws=draws,
        seed=seed,
        max_effects=max_effects,
        effort=effort,
        minutes=minutes,
        device=device,
        resume=resume,
        progress=progress,
    )
    print(found.summary())
    print(f"results in {found.folder}: open report.html, go on with model_after.yaml")
