"""The `import` command: tables of a testing machine or a tracker, or videos, become a folder to diagnose; scenes one to simulate."""


def import_data(
    files: list[str],
    *,
    out: str | None = None,
    kind: str = "auto",
    mode: str = "uniaxial",
    columns: dict[str, str] | None = None,
    units: dict[str, str] | None = None,
    strain_unit: str | None = None,
    length: str | None = None,
    width: str | None = None,
    thickness: str | None = None,
    section_diameter: str | None = None,
    area: str | None = None,
    compression: bool = False,
    zero: str = "none",
    rows: str = "",
    average: int = 1,
    cycles: str = "together",
    step: str | None = None,
    sheet: str | None = None,
    forces: str | None = None,
    region: list[float] | None = None,
    elements: str | None = None,
    condition: str | None = None,
    density: float | None = None,
    young: float | None = None,
    poisson: float | None = None,
    scale: float | None = None,
    y_down: bool = False,
    up: str = "y",
    frame_rate: float | None = None,
    point: str | None = None,
    mass: float | None = None,
    diameter: float | None = None,
    volume: float | None = None,
    floor: float | None = None,
    guide: str = "none",
    stiffness: float | None = None,
    inertia: float | None = None,
    restitution: float | None = None,
    tilt: float | None = None,
    start: float | None = None,
    end: float | None = None,
    background: str | None = None,
    cameras: str | None = None,
    board: str | None = None,
    synchronise: str = "none",
    offsets: list[float] | None = None,
    picture: str | None = None,
    held_out: str = "",
    particles: int | None = None,
    opacity_threshold: float | None = None,
    dry_run: bool = False,
) -> None:
    """Turn tables of a testing machine, exports of a tracker or of motion capture, or videos into a folder that `neuido diagnose` reads.

    Scenes of MuJoCo (.xml), robots (.urdf), USD, PhysGaussian (.json) and Spring-Gaus (.yaml), meshes and Gaussians (3DGS .ply) become a
    folder with scene.yaml, which `neuido simulate` runs.

    Prints what was understood. What a file does not say is asked for, by the name of its option.

    Args:
        files: Files, one a recording; text of any dialect, xlsx, xls, trc, c3d, h5 or video (mp4, mov, avi, mkv). A table of several
            specimens is several tests. Of a scene one, and after it the body where the scene has none: a mesh or Gaussians.
        out: Folder to write, which must not be there.
        kind: auto, material (a testing machine), track (a body as one point), body (points on a deforming body, or its outline in a video),
            field (displacements by digital image correlation) or scene (of another program).
        mode: Of a material test: uniaxial, compression, equibiaxial, pure_shear, biaxial or simple_shear.
        columns: Quantity and title, where titles do not say it: --columns.force "Channel 2".
        units: Quantity and unit, where the table gives none: --units.force kN.
        strain_unit: Unit of the strain: percent, or a ratio such as mm/mm.
        length: Gauge length of the specimen, or of a pendulum from the pivot to its centre of mass, with the unit, as "50 mm".
        width: Its width, with a unit.
        thickness: Its thickness, with a unit; of an outline, the depth of the body along the line of sight. A body of revolution about the
            vertical axis where absent.
        section_diameter: Of a round specimen, with a unit.
        area: Cross-section in place of width, thickness and diameter, as "20 mm^2".
        compression: Whether the table counts compression as positive. In mode compression the signs are found.
        zero: Zero of the strain: none, first (the first row, of the stress too), toe (where the straight line of the first loading meets
            zero stress, as in ASTM D638), or a preload as "0.5 N".
        rows: Data rows to use, as START:STOP or START:STOP:STEP from 0.
        average: Rows whose mean becomes one row.
        cycles: together: one history. split: each loading and unloading is a test, of the same specimen.
        step: Step of shear that a relaxation modulus belongs to, as 0.01 or "1 %".
        sheet: Of a spreadsheet the only sheet to read.
        forces: Of a full field, a table with the force at each image. On a mesh, a row a load step with the force on each part of the
            boundary (right_x, top_y), or with * one file a load step with a row a part.
        region: Of a full field, the part to use: smallest and largest x, smallest and largest y, in the unit of the files. Of Gaussians,
            the part that is the body: smallest and largest x, y and z.
        elements: Of a full field on the nodes of a mesh, the table of its triangles or quadrilaterals (node1, node2, node3); a hole or a
            notch is then no obstacle.
        condition: Of such a specimen, plane stress (it is thin) or strain (thick, or held between plates).
        density: kg/m^3.
        young: A guess of Young's modulus, in Pa.
        poisson: Poisson's ratio; a material test without it is incompressible.
        scale: Metres a unit of the positions, for example metres a pixel; of several cameras, a unit of their positions.
        y_down: Whether y points down, as in images.
        up: The axis that points up, y or z; of a board, z if it lies flat and y if it stands upright.
        frame_rate: Frames a second, where the file counts frames; of a video in slow motion, the true ones.
        point: Of several points the one to follow, or mean.
        mass: Of the body in kg.
        diameter: Of the body in m; of a video without --scale, it gives the scale.
        volume: Of a deforming body in m^3; the hull of the first frame where absent.
        floor: Height of a floor in m; of a body that bounces, that of the tracked point when it touches; of an
            outline, above the lower edge of the picture.
        guide: What guides the body of a track: none (it flies), pendulum, spring, axis, plane or bounce.
        stiffness: Of a spring in N/m, or of an axis per moment of inertia in 1/s^2; a rough value.
        inertia: Of a body on a plane, its moment of inertia over m r^2: 0.4 of a solid ball that rolls, 0 of what slides.
        restitution: Of a body that bounces; a rough value.
        tilt: Of the plane, in degrees; x then points down the slope and y away from it.
        start: Of a video, the first moment to use, s.
        end: Of a video, the last moment to use, s.
        background: Of a video, an image of the empty scene; the median of the frames where absent.
        cameras: Of the clips of one motion from several cameras: board (a printed ChArUco board), colmap, or a recording with their views.
            Of tables of pixels, one a view and named like it, the recording: the points are triangulated.
        board: Its squares in x and y, side of a square, side of a marker, dictionary, as "7x5 40 mm 30 mm 4X4_50".
        synchronise: How clips of several cameras are aligned in time: none (started together), flash (of light) or audio (a clap).
        offsets: Instead, what to add to the times of each clip, s.
        picture: Of videos, a PNG file for frames with the outline that was found; written with --dry_run too.
        held_out: Names of recordings that are only scored, with commas; the last of several where absent.
        particles: Of a scene, the approximate number of particles of a body; 4000 where absent.
        opacity_threshold: Of Gaussians, the opacity at or below which they are left out; that of the scene or 0.02 where absent.
        dry_run: Only say what was understood.

    Raises:
        UserError: What cannot be read or is missing.
    """
    given = dict(locals())

    from pathlib import Path

    from neuido.data.files.writing import check_writable
    from neuido.data.footage.filming import Filming
    from neuido.data.importers.declared_guide import Guide
    from neuido.data.importers.importing import import_file
    from neuido.data.importers.machines.loading_path import Preparation
    from neuido.data.importers.machines.testing_machine import Specimen
    from neuido.errors import UserError

    if out is not None and not dry_run:
        check_writable(Path(out).expanduser())
    unsaid = "give --out FOLDER, or --dry_run true" if out is None and not dry_run else ""
    if _is_scene(files, kind):
        if unsaid:
            raise UserError(unsaid)
        _check_scene_options(given)
        from neuido.models.reconstruct.scene_import import PARTICLES, import_scene

        options = {key: given[key] for key in ("opacity_threshold", "density", "young", "poisson", "scale", "region")}
        axis = None if up == "y" else up
        lines = import_scene(files, None if dry_run else out, particles=PARTICLES if particles is None else particles, up=axis, **options)
        print("\n".join(lines))
        print(f"results in {out}" if out is not None and not dry_run else "nothing is written (--dry_run)")
        return
    if particles is not None or opacity_threshold is not None:
        raise UserError("--particles and --opacity_threshold are for scenes alone: leave them out, or give --kind scene")
    if picture is not None:
        check_writable(Path(picture).expanduser().parent, "picture")
    try:
        lines = import_file(
            files,
            None if dry_run else out,
            kind=kind,
            mode=mode,
            columns=columns,
            units={**({"strain": strain_unit} if strain_unit else {}), **(units or {})},
            specimen=Specimen(length if guide == "none" else None, width, thickness, section_diameter, area),
            filming=Filming(start, end, background, cameras, board, synchronise, offsets, picture),
            compression=compression,
            preparation=Preparation(rows, average, zero, cycles),
            step=step,
            sheet=sheet,
            forces=forces,
            region=region,
            elements=elements,
            condition=condition,
            density=density,
            young=young,
            poisson=poisson,
            scale=scale,
            y_down=y_down,
            up=up,
            frame_rate=frame_rate,
            point=point,
            mass=mass,
            diameter=diameter,
            volume=volume,
            floor=floor,
            guide=Guide(guide, None if guide == "none" else length, stiffness, inertia, restitution, tilt),
            held_out=[name for name in held_out.split(",") if name],
        )
    except UserError as error:
        raise UserError(f"{error}; and {unsaid}" if unsaid and "give --" in str(error) else str(error)) from error
    print("\n".join(lines))
    if unsaid:
        raise UserError(f"nothing is written: {unsaid}")
    print(f"results in {out}" if out is not None and not dry_run else "nothing is written (--dry_run)")


SCENES = (".xml", ".urdf", ".json", ".yaml", ".yml", ".usd", ".usda", ".usdc", ".usdz", ".obj", ".stl", ".ply", ".glb")
"""Endings of scenes, meshes and Gaussians."""
FOR_SCENES = ("files", "out", "kind", "density", "young", "poisson", "scale", "up", "particles", "opacity_threshold", "region",
              "dry_run")  # fmt: skip
"""Options that a scene takes."""


def _is_scene(files: list[str], kind: str) -> bool:
    return kind == "scene" or (kind == "auto" and bool(files) and str(files[0]).lower().endswith(SCENES))


def _check_scene_options(given: dict) -> None:
    """Raise UserError for an option that a scene does not take."""
    import inspect

    from neuido.errors import UserError

    for name, parameter in inspect.signature(import_data).parameters.items():
        if name not in FOR_SCENES and given[name] != parameter.default:
            raise UserError(f"--{name} is not for scenes: leave it out; they take {', '.join(f'--{own}' for own in FOR_SCENES[1:])}")
