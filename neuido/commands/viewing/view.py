"""The `view` command: motions, recordings, diagnoses and Gaussians in the browser, and scenes live. `--help` loads no torch."""

HOST, PORT = "localhost", 8080


def view_path(
    path: str,
    *,
    recording: str | None = None,
    colour: str | None = None,
    law: str | None = None,
    latents: list[str] | None = None,
    operator: str | None = None,
    data_root: str | None = None,
    host: str = HOST,
    port: int = PORT,
    once: bool = False,
) -> None:
    """Open a page in the browser: a motion to play, or a scene that is simulated while one looks: `neuido view PATH`.

    A page of a motion has play, time, speed and colours. A page of a scene has play, step, reset, gravity and the parameters of the law,
    and the mouse pulls the body. Ctrl+C ends it. The page needs the extra `viewer`.

    Args:
        path: A rollout (.npz), a folder of `simulate`, `predict` or `diagnose`, an experiment, a recording, PLY files of particles or
            Gaussians, or a scene file (.yaml), which is simulated live.
        recording: Name of the recording, body or scene to show, where there are several; the first where absent.
        colour: Quantity by which particles are coloured at first: speed, "von Mises stress", strain, "plastic strain", "volume ratio",
            displacement, residual or body.
        law: Of a scene: a learned law, a .safetensors file; the scene's own law where absent.
        latents: Of a scene: names of two latents of an operator, such as [a, b]; a slider leads from the law of one to that of the other.
        operator: The operator of the latents: a name of released weights or a checkpoint; `pretrained` where absent.
        data_root: Of a scene: folder of the particles that it names; that of NEUIDO_DATA where absent.
        host: Address to listen at. 0.0.0.0 lets other machines see and use the page.
        port: Port to listen at; another one where it is in use.
        once: Build the page, say where it is, and end, as a check.

    Raises:
        UserError: Nothing to show, an impossible option, a missing extra.
    """
    from neuido.viewer.opening import check_scene_options, open_path

    check_scene_options(path, {"law": law, "latents": latents, "operator": operator, "data_root": data_root})
    page = open_path(
        path, recording=recording, colour=colour, law=law, latents=latents, operator=operator, data_root=data_root, host=host, port=port
    )
    try:
        print(f"{page.title} is at {page.url}" + ("" if once else "; Ctrl+C ends it"), flush=True)
        if not once:
            page.wait()
    finally:
        page.stop()
