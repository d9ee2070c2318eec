"""Tables in other languages, clocks, marks and arrangements than those of `test_table_kinds` give the same numbers, or one clear line."""

import numpy as np
import pytest

import neuido
from neuido.data.importers.machines.testing_machine import Specimen
from neuido.errors import UserError

pytest.importorskip("pint")
STRETCH = np.linspace(1, 1.5, 26)
STRESS = 4e5 * (STRETCH - STRETCH**-2)  # Pa
TIME = np.arange(26) * 0.1
AREA = 20e-6  # m^2
SPECIMEN = Specimen("50 mm", "10 mm", "2 mm")
T = np.arange(31) / 30
FLIGHT = np.stack([0.3 + 2 * T, 1 + 4 * T - 4.905 * T**2, 0.2 + 0.1 * T], 1)


def comma(value, digits=8):
    return f"{value:.{digits}f}".replace(".", ",")


def grouped(value, mark, decimal):
    return f"{value:,.2f}".replace(".", "#").replace(",", mark).replace("#", decimal)


def stretches(head, strain, stress, separator=";"):
    return [head, *(f"{strain(a)}{separator}{stress(s)}" for a, s in zip(STRETCH, STRESS))]


def clocks(head, clock):
    return [head, *(f"{clock(t)},{100 * (a - 1):.6f},{s / 1e3:.6f}" for t, a, s in zip(TIME, STRETCH, STRESS))]


def percent(a):
    return comma(100 * (a - 1))


def newton(s):
    return comma(s * AREA)


def plain_percent(a):
    return f"{100 * (a - 1):.6f}"


PLAIN = stretches("Strain (%),Stress (kPa)", plain_percent, lambda s: f"{s / 1e3:.6f}", ",")
SECTION = ["Extension (mm),Load (N)", *(f"{50 * (a - 1):.8f},{s * AREA:.8f}" for a, s in zip(STRETCH, STRESS))]
MACHINES = {
    "French": (["Essai du 12/03/2024", *stretches("Allongement (mm);Force (N)", lambda a: comma(50 * (a - 1)), newton)], SPECIMEN),
    "French sizes": (
        [
            "Longueur initiale;50;mm",
            "Largeur;10;mm",
            "Épaisseur;2;mm",
            *stretches("Déplacement;Effort", lambda a: comma(50 * (a - 1)), newton)[:1],
            "mm;N",
            *stretches("", lambda a: comma(50 * (a - 1)), newton)[1:],
        ],
        None,
    ),
    "French stress": (stretches("Déformation (%);Contrainte (MPa)", percent, lambda s: comma(s / 1e6)), None),
    "Spanish": (stretches("Deformación (%);Tensión (MPa)", percent, lambda s: comma(s / 1e6)), None),
    "an elongation in percent": (stretches("Elongation (%);Stress (MPa)", percent, lambda s: comma(s / 1e6)), None),
    "a strain in mm": (stretches("Dehnung (mm);Kraft (N)", lambda a: comma(50 * (a - 1)), newton), SPECIMEN),
    "blanks": (stretches("Strain (%);Stress (Pa)", plain_percent, lambda s: grouped(s, " ", ".")), None),
    "thin blanks": (stretches("Strain (%);Stress (Pa)", percent, lambda s: grouped(s, "\u202f", ",")), None),
    "apostrophes": (stretches("Strain (%);Stress (Pa)", plain_percent, lambda s: grouped(s, "'", ".")), None),
    "pounds and inches": (
        [
            SECTION[0].replace("mm", "inches").replace("(N)", "(lbs)"),
            *(f"{2e3 * (a - 1) / 1016:.9f},{s * AREA / 4.4482216:.9f}" for a, s in zip(STRETCH, STRESS)),
        ],
        SPECIMEN,
    ),
    "an area above": (["Cross-sectional area: 20 mm²", "Gauge length: 50 mm", *SECTION], None),
    "an area as an option": (SECTION, Specimen("50 mm", area="0.2 cm^2")),
    "rows of a summary": (["Point," + PLAIN[0], *(f"{i},{row}" for i, row in enumerate(PLAIN[1:])), "Mean,25,110", "SD,15,70"], None),
    "results below": ([*PLAIN, "Results", "Max strain (%),Max stress (kPa)", "50,222"], None),
    "titles again": ([*PLAIN[:14], PLAIN[0], *PLAIN[14:]], None),
    "pages": ([*PLAIN[:14], "", "Page 2", PLAIN[0], *PLAIN[14:]], None),
    "titles in two rows": (["Strain,Stress", "axial (%),nominal (kPa)", *PLAIN[1:]], None),
}


@pytest.mark.parametrize("kind", MACHINES)
def test_machines(tmp_path, kind):
    lines, specimen = MACHINES[kind]
    (tmp_path / "a.csv").write_text("\n".join([*lines, ""]))
    neuido.import_file(tmp_path / "a.csv", tmp_path / "out", specimen=specimen)
    (test,) = neuido.read_material_tests(tmp_path / "out").tests
    np.testing.assert_allclose(test.path[:, 0], STRETCH, atol=1e-6)
    np.testing.assert_allclose(test.stress[:, 0], STRESS, rtol=1e-3, atol=10)


@pytest.mark.parametrize(
    "clock",
    [
        lambda t: f"00:00:{t:06.3f}",
        lambda t: f"00:{t:06.3f}",
        lambda t: f"2024-03-05T{'09:59' if t < 2 else '10:00'}:{(58 + t) % 60:06.3f}Z",
        lambda t: f"2024-03-05T{'09:59' if t < 2 else '10:00'}:{(58 + t) % 60:06.3f}+01:00",
        lambda t: f"05.03.2024 10:00:{t:06.3f}",
        lambda t: f"3/5/2024 10:00:{t:06.3f} AM",
        lambda t: f"{'23:59' if t < 2 else '00:00'}:{(58 + t) % 60:06.3f}",
    ],
)
def test_clocks(tmp_path, clock):
    (tmp_path / "a.csv").write_text("\n".join([*clocks("Time,Strain (%),Stress (kPa)", clock), ""]))
    neuido.import_file(tmp_path / "a.csv", tmp_path / "out")
    (test,) = neuido.read_material_tests(tmp_path / "out").tests
    np.testing.assert_allclose(test.time, TIME, atol=1e-6)


def test_a_number_for_a_missing_one(tmp_path):
    rows = list(PLAIN)
    for i, word in ((4, "-"), (9, "9999"), (12, "N/A"), (15, "***")):
        rows[i] = rows[i].split(",")[0] + f",{word}"
    (tmp_path / "a.csv").write_text("\n".join([*rows, ""]))
    said = neuido.import_file(tmp_path / "a.csv", tmp_path / "out")
    (test,) = neuido.read_material_tests(tmp_path / "out").tests
    np.testing.assert_allclose(test.stress[:, 0], np.delete(STRESS, [3, 8, 11, 14]), rtol=1e-4, atol=1)
    assert any("1 rows with 9999 count as missing" in line for line in said)


def flights(head, row, count=31):
    return [head, *(row(i, t, *x) for i, (t, x) in enumerate(zip(T[:count], FLIGHT)))]


def xyz(x, y, z, factor=1.0):
    return f"{factor * x:.6f},{factor * y:.6f},{factor * z:.6f}"


MOTIONS = {
    "names before axes": (flights("t,ball_x,ball_y,ball_z", lambda i, t, *x: f"{t:.6f},{xyz(*x)}"), {}),
    "names after axes": (flights("t,X_ball,Y_ball,Z_ball", lambda i, t, *x: f"{t:.6f},{xyz(*x)}"), {}),
    "two points": (flights("t,ball_x,ball_y,ball_z,cart x,cart y,cart z", lambda i, t, *x: f"{t:.6f},{xyz(*x)},0,0,1"), {"point": "ball"}),
    "positions": (flights("Time [s],X-Position [mm],Y-Position [mm],Z-Position [mm]", lambda i, t, *x: f"{t:.6f},{xyz(*x, 1e3)}"), {}),
    "units above": (["Time (s),Position (mm),,", *flights(",X,Y,Z", lambda i, t, *x: f"{t:.6f},{xyz(*x, 1e3)}")], {}),
    "coordinates": (flights("Zeit,x-Koordinate,y-Koordinate,z-Koordinate\ns,mm,mm,mm", lambda i, t, *x: f"{t:.6f},{xyz(*x, 1e3)}"), {}),
    "axes in their own units": (flights("t (s),x (m),y (mm),z (cm)", lambda i, t, x, y, z: f"{t:.6f},{x},{1e3 * y},{1e2 * z}"), {}),
    "z up": (flights("t,x,y,z", lambda i, t, x, y, z: f"{t:.6f},{xyz(x, -z, y)}"), {"up": "z"}),
    "copies of rows": (
        [row for i, row in enumerate(flights("t,x,y,z", lambda i, t, *x: f"{t:.6f},{xyz(*x)}")) for _ in range(1 + (i % 3 == 1))],
        {},
    ),
    "SLEAP": (flights("track,frame_idx,instance.score,nose.x,nose.y,nose.z", lambda i, t, *x: f",{i},1,{xyz(*x)}"), {"frame_rate": 30.0}),
    "Vicon with other sections": (
        [
            "Model Outputs",
            "100",
            ",,s:ball,,",
            ",,X,Y,Z",
            ",,mm,mm,mm",
            *(f"{i},0,{i},{i},{i}" for i in range(1, 9)),
            "Trajectories",
            "30",
            ",,s:ball,,",
            "Frame,Sub Frame,X,Y,Z",
            ",,mm,mm,mm",
            *flights("", lambda i, t, *x: f"{i + 10},0,{xyz(*x, 1e3)}")[1:],
            "Devices",
            "900",
            "Frame,Sub Frame,F",
        ],
        {},
    ),
}


@pytest.mark.parametrize("kind", MOTIONS)
def test_motions(tmp_path, kind):
    lines, options = MOTIONS[kind]
    (tmp_path / "a.csv").write_text("\n".join([*lines, ""]))
    neuido.import_file(tmp_path / "a.csv", tmp_path / "out", **options)
    (track,) = neuido.read_tracks(tmp_path / "out").recordings
    np.testing.assert_allclose(track.t, T, atol=1e-5)
    np.testing.assert_allclose(track.x, FLIGHT, atol=1e-5)


@pytest.mark.parametrize("mark", [";", ":"])
def test_timecodes_count_frames(tmp_path, mark):
    """At 29.97 frames a second, drop-frame timecode leaves out 00 and 01 in each minute but every tenth."""
    rate, lines = 30000 / 1001, ["Timecode,x,y,z"]
    for i, x in enumerate(FLIGHT):
        count = 1790 + i
        count += 2 * (mark == ";" and count >= 1800)
        lines.append(f"01:{count // 1800:02d}:{count % 1800 // 30:02d}{mark}{count % 30:02d},{xyz(*x)}")
    (tmp_path / "a.csv").write_text("\n".join([*lines, ""]))
    with pytest.raises(UserError, match=r"times that end in frames \(up to 29\): give --frame_rate"):
        neuido.import_file(tmp_path / "a.csv", None)
    neuido.import_file(tmp_path / "a.csv", tmp_path / "out", frame_rate=rate)
    np.testing.assert_allclose(neuido.read_tracks(tmp_path / "out").recordings[0].t, np.arange(31) / rate, atol=1e-6)


def test_individuals_of_deeplabcut(tmp_path):
    head = [
        "scorer,n,n,n,n,n,n",
        "individuals,a,a,a,b,b,b",
        "bodyparts,nose,nose,nose,nose,nose,nose",
        "coords,x,y,likelihood,x,y,likelihood",
    ]
    lines = [*head, *(f"{i},{x},{-y},0.99,5,6,0.99" for i, (x, y, _) in enumerate(FLIGHT))]
    (tmp_path / "a.csv").write_text("\n".join([*lines, ""]))
    neuido.import_file(tmp_path / "a.csv", tmp_path / "out", scale=1.0, y_down=True, frame_rate=30.0, point="a-nose")
    np.testing.assert_allclose(neuido.read_tracks(tmp_path / "out").recordings[0].x, FLIGHT[:, :2], atol=1e-6)


def test_several_recordings_in_one_table(tmp_path):
    rows = [f"{name},{1e3 * t:.3f},{xyz(*x)}" for name in ("first", "second") for t, x in zip(T, FLIGHT)]
    (tmp_path / "a.csv").write_text("\n".join(["take,t (ms),x,y,z", *rows, ""]))
    said = neuido.import_file(tmp_path / "a.csv", tmp_path / "out", held_out=["a-first"])
    tracks = neuido.read_tracks(tmp_path / "out").recordings
    assert [(track.name, track.role) for track in tracks] == [("a-first", "held_out"), ("a-second", "fit")]
    assert "held out: a-first (--held_out NAMES)" in said
    for track in tracks:
        np.testing.assert_allclose(track.x, FLIGHT, atol=1e-6)


REFUSED = {
    "z up and not said": (flights("t,x,y,z", lambda i, t, x, y, z: f"{t:.6f},{xyz(x, -z, y)}"), "as of gravity, .* Give --up z"),
    "a clock that starts again": (
        flights("t,x,y,z", lambda i, t, *x: f"{t % 0.5:.6f},{xyz(*x)}"),
        "start again at data row 15: .*--columns.rec",
    ),
    "a coarse clock": (flights("t,x,y,z", lambda i, t, *x: f"{t:.1f},{xyz(*x)}"), "20 of 31 rows have the time of another row"),
    "recordings not told apart": (
        ["t,id,x,y,z", *(f"{t},{p},{xyz(*(x + p + s))}" for s in (0, 9) for t, x in zip(T, FLIGHT) for p in range(9))],
        r"279 of 558 rows repeat the time of a point .*--columns\.recording",
    ),
    "an axis without a unit": (flights("t,x (m),y,z (m)", lambda i, t, *x: f"{t:.6f},{xyz(*x)}"), "column 'y' has no unit and others have"),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_refused(tmp_path, kind):
    lines, words = REFUSED[kind]
    (tmp_path / "a.csv").write_text("\n".join([*lines, ""]))
    with pytest.raises(UserError, match=words):
        neuido.import_file(tmp_path / "a.csv", tmp_path / "out", **({"density": 1e3, "young": 1e5} if "id" in lines[0] else {}))
    assert not (tmp_path / "out").exists()


def test_a_place_that_was_not_seen_is_no_copy_of_one_at_zero(tmp_path):
    """Of rows at one time, one with y = 0 and one without y are two places: the clock is too coarse."""
    rows = [f"{0.05 * (i // 2):.2f},{0.1 * (i // 2):.3f},{'0' if i % 2 else ''}" for i in range(40)]
    (tmp_path / "coarse.csv").write_text("t (s),x (m),y (m)\n" + "\n".join(rows) + "\n")
    with pytest.raises(UserError, match=r"20 of 40 rows have the time of another row and another place"):
        neuido.import_file(tmp_path / "coarse.csv", tmp_path / "out", kind="track")
