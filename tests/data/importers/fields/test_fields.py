"""Full fields of a pulled strip in the layout of each program, and what they cannot tell yet."""

import numpy as np
import pytest

import neuido
from neuido.data.importers.machines.testing_machine import Specimen
from neuido.errors import UserError

SPECIMEN = Specimen(width="10 mm", thickness="2 mm")
STRETCH = np.linspace(1.0, 1.3, 7)
STRESS = 3e5 * (STRETCH - STRETCH**-2)
I, J = (part.ravel() for part in np.meshgrid(np.arange(9), np.arange(6), indexing="ij"))


def motion(k: int, unit: float = 1.0, hole: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Places and displacements of image k, pulled along y, with a rotation, a shift and some noise."""
    x = unit * np.stack([10.0 + 2 * J, 5.0 + 2 * I], 1)
    a = STRETCH[k]
    turned = np.array([[np.cos(0.01 * k), -np.sin(0.01 * k)], [np.sin(0.01 * k), np.cos(0.01 * k)]]) @ np.diag([a**-0.45, a])
    u = x @ (turned - np.eye(2)).T + 0.3 * k + np.random.default_rng(k).normal(0, 2e-4 * unit, x.shape)
    return x, u + hole * (a - 1) * np.exp(-((x - x.mean(axis=0)) ** 2).sum(axis=1, keepdims=True) / 8)


def rows(path, titles, *columns, separator=","):
    path.write_text("\n".join([separator.join(titles), *(separator.join(f"{v:.6f}" for v in row) for row in zip(*columns)), ""]))
    return path


def vic2d(folder, **options):
    for k in range(7):
        x, u = motion(k, **options)
        sigma = np.where(np.arange(len(x)) == 5, -1.0, 0.01)
        u[5] = 1e3  # a point that was lost
        rows(folder / f"strip-{k}_0.csv", [' "x"', ' "y"', ' "u"', ' "v"', ' "sigma"', ' "exx"'], *x.T, *u.T, sigma, 0 * sigma)


def vic3d(folder):
    for k in range(7):
        x, u = motion(k)
        wrong = np.full(len(x), 7.0)  # in pixels, beside those in mm
        titles = ['"X"', '"Y"', '"Z"', '"U"', '"V"', '"W"', '"x"', '"y"', '"u"', '"v"', '"sigma"']
        rows(folder / f"strip-{k}_0.csv", titles, *x.T, 0 * wrong, *u.T, 0 * wrong, wrong, wrong, wrong, wrong, 0 * wrong)


def aramis(folder):
    for k in range(7):
        x, u = motion(k)
        titles = ["id", "x [mm]", "y [mm]", "z [mm]", "displacement_x [mm]", "displacement_y [mm]", "displacement_z [mm]"]
        rows(folder / f"strip-{k}.csv", titles, np.arange(len(x)), *x.T, 0 * x[:, 0], *u.T, 0 * x[:, 0], separator=";")


def pyvale(folder):
    for k in range(7):
        x, u = motion(k)
        found = np.where(np.arange(len(x)) == 3, 0.0, 1.0)
        u[3] = 0.0
        rows(
            folder / f"strip-{k}.csv",
            ["subset_x", "subset_y", "displacement_u", "displacement_v", "converged", "cost"],
            *x.T,
            *u.T,
            found,
            found,
        )


def dice(folder):
    for k in range(7):
        x, u = motion(k)
        titles = ["SUBSET_ID", "COORDINATE_X", "COORDINATE_Y", "DISPLACEMENT_X", "DISPLACEMENT_Y", "SIGMA"]
        rows(folder / f"strip-{k:02d}.txt", titles, np.arange(len(x)), *x.T, *u.T, 0.01 + 0 * x[:, 0])


def ncorr(folder):
    from scipy.io import savemat

    images = []
    for k in range(7):
        _, u = motion(k, unit=0.5)  # two units a step, as spacing 3 and 0.25 units a pixel have them, and half of it
        parts = {f"plot_{axis}_ref_formatted": u[:, a].reshape(9, 6) for a, axis in enumerate("uv")}
        images.append({**parts, "roi_ref_formatted": {"mask": np.ones((9, 6), bool)}})
    saved = {"displacements": images, "dispinfo": {"pixtounits": 0.25, "spacing": 3.0}}
    savemat(folder / "strip.mat", {"data_dic_save": saved, "reference_save": np.zeros(3)})


def mudic(folder):
    places = np.stack([np.add(*motion(k)).reshape(9, 6, 2) for k in range(7)])
    np.save(folder / "strip.npy", np.moveaxis(places, (0, 3), (3, 0))[None])


def files(folder, write, **options):
    (folder / "in").mkdir()
    write(folder / "in", **options)
    rows(folder / "forces.csv", ["Time (s)", "Force (N)"], np.arange(7) + 2.0, STRESS * 20e-6)
    return sorted((folder / "in").iterdir())


@pytest.mark.parametrize("write", [vic2d, vic3d, aramis, pyvale, dice, ncorr, mudic])
def test_a_pulled_strip_becomes_a_material_test(tmp_path, write):
    said = neuido.import_file(files(tmp_path, write), tmp_path / "out", specimen=SPECIMEN, forces=str(tmp_path / "forces.csv"))
    (test,) = neuido.read_material_tests(tmp_path / "out").tests
    np.testing.assert_allclose(test.path[:, 0], STRETCH, atol=2e-4)
    np.testing.assert_allclose(test.stress[:, 0], STRESS, atol=1.0)
    assert test.time is not None and test.time[-1] == 6.0
    assert any("strained along y up to 1.3" in line for line in said) and any("logarithmic strain 0.45" in line for line in said)


def test_what_a_field_cannot_tell(tmp_path):
    paths = files(tmp_path, vic2d)
    forces, short = str(tmp_path / "forces.csv"), rows(tmp_path / "short.csv", ["Force (N)", "b"], *np.ones((2, 6)))
    for options, match in (
        ({}, "give --forces FILE"),
        ({"forces": str(tmp_path / "absent.csv")}, "absent.csv is missing"),
        ({"forces": str(short)}, "6 rows and there are 7 images"),
        ({"forces": forces}, "give --width and --thickness"),
        ({"forces": forces, "specimen": SPECIMEN, "region": [0, 1, 0, 1]}, "they lie in x 10 to 20 and y 5 to 21"),
        ({"forces": forces, "specimen": SPECIMEN, "region": [1.0]}, "must be the smallest x"),
    ):
        with pytest.raises(UserError, match=match):
            neuido.import_file(paths, tmp_path / "out", **options)
        assert not (tmp_path / "out").exists()
    bent = tmp_path / "bent"
    bent.mkdir()
    with pytest.raises(UserError, match=r"strain is not uniform: .*--region"):
        neuido.import_file(files(bent, vic2d, hole=8.0), tmp_path / "out", specimen=SPECIMEN, forces=forces)


@pytest.mark.parametrize(("name", "content"), [("a.mat", b"MATLAB 5.0"), ("a.mat", b""), ("a.npy", b"\x93NUMPY"), ("b.npy", b"")])
def test_damaged_files_end_in_one_line(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(UserError, match=name):
        neuido.import_file(tmp_path / name, tmp_path / "out", forces="f.csv")
    np.save(tmp_path / "c.npy", np.array([{"a": 1}], dtype=object))
    np.save(tmp_path / "d.npy", np.zeros((3, 3)))
    for other, match in (("c.npy", "not a valid NumPy array"), ("d.npy", r"has the shape \(3, 3\)")):
        with pytest.raises(UserError, match=match):
            neuido.import_file(tmp_path / other, tmp_path / "out", forces="f.csv")


def test_a_plate_with_a_hole_is_refused(tmp_path, data_root):
    folder = data_root / "measured" / "plate-known-truth"
    if not folder.is_dir():
        pytest.skip("NEUIDO_DATA has no plate")
    paths = sorted(folder.glob("nodes_*.csv"))
    rows(tmp_path / "forces.csv", ["Force (N)", "b"], *np.ones((2, 4)))
    with pytest.raises(UserError, match="strain is not uniform"):
        neuido.import_file(paths, tmp_path / "out", specimen=SPECIMEN, forces=str(tmp_path / "forces.csv"))
