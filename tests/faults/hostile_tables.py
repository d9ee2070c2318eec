"""Malformed and hostile tables by kind: name, content and options of `import_file`; each is refused in one line."""

import io
import zipfile
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from neuido.data.importers.machines.loading_path import Preparation
from neuido.data.importers.machines.testing_machine import Specimen

ROWS = [f"{0.01 * i:.4f},{1e4 * i:.1f}" for i in range(20)]
TENSILE = ["Strain (mm/mm),Stress (Pa)", *ROWS]
T = np.arange(20) / 30
TRACK = ["t,x,y", *(f"{t:.5f},{2 * t:.5f},{1 + 3 * t - 4.905 * t * t:.5f}" for t in T)]


class Hostile(NamedTuple):
    """One input."""

    kind: str
    name: str
    content: bytes
    options: dict[str, Any]
    file: str = "a.csv"


def text(kind: str, name: str, lines: list[str] | str, /, **options: Any) -> Hostile:
    content = lines if isinstance(lines, str) else "\n".join([*lines, ""])
    return Hostile(kind, name, content.encode(), options)


def column(title: str, values: list[Any], other: str = "Stress (Pa)", rows: list[Any] | None = None) -> list[str]:
    """A table of two columns."""
    return [f"{title},{other}", *(f"{a},{b}" for a, b in zip(values, rows or [1e4 * i for i in range(len(values))]))]


def no_tables() -> Iterator[Hostile]:
    contents = {
        "empty": "", "blank lines": "\n\n\n", "one word": "hello", "html": "<html><body><table><tr><td>1</td></tr></table></body></html>",
        "json": '{"a": [1, 2, 3]}', "yaml": "a: 1\nb: 2\nc: 3\n", "comments alone": "# t x\n# 1 2\n", "titles alone": "Strain,Stress\n",
        "units alone": "Strain,Stress\n(%),(MPa)\n", "one row": "Strain,Stress\n1,2\n", "two rows": "Strain,Stress\n1,2\n2,3\n",
        "one column": "Strain\n1\n2\n3\n4\n", "words in each cell": "a,b\n" + "c,d\n" * 20, "a poem": "roses are red\n" * 30,
        "a long line": "x" * 200_000, "many separators": "," * 5000, "semicolons": ";;;;\n" * 200, "quotes": '"' * 1001,
        "braces": "{" * 5000, "an URL": "http://localhost/a.csv\n" * 4, "a shell line": "$(touch evil)\n`touch evil`\n; touch evil\n",
        "a pickle": "cos\nsystem\n(S'touch evil'\ntR.\n",
    }  # fmt: skip
    for name, content in contents.items():
        yield text("no table", name, content)


def encodings() -> Iterator[Hostile]:
    body = "\n".join(TENSILE).encode()
    contents = {
        "zeros": b"\0" * 100, "zeros in a table": body[:40] + b"\0\0\0" + body[40:], "an odd UTF-16": b"\xff\xfe" + body + b"\0",
        "a byte order mark": b"\xef\xbb\xbf", "undefined in cp1252": b"\x81\x8d\x8f\x90\x9d" + b"\xff" * 20,
        "an executable": b"\x7fELF\x02\x01\x01" + bytes(range(256)), "a PNG": b"\x89PNG\r\n\x1a\n" + bytes(64),
        "UTF-32": "a,b\n1,2\n".encode("utf-32"),
        "random": np.random.default_rng(0).bytes(3000),
    }  # fmt: skip
    for name, content in contents.items():
        yield Hostile("encoding", name, content, {})


def quotes() -> Iterator[Hostile]:
    for name, line in {"open": '"0.1,2', "open title": '"Strain', "within": '0.1,"2"3', "odd": '"0.1""2,3', "newline": '"0.1'}.items():
        yield text("quotes", name, [*TENSILE[:6], line, *TENSILE[6:]])


def numbers() -> Iterator[Hostile]:
    cells = {
        "NaN": "nan", "inf": "inf", "minus inf": "-inf", "beyond float": "1e999", "hexadecimal": "0x10", "underscores": "1_000",
        "Arabic digits": "\u0661\u0662", "two points": "1.2.3", "an exponent alone": "e5", "a formula": "=1+1",
        "a call": "__import__('os')",
        "a date": "2024-13-45", "a long number": "9" * 400, "minus": "-", "a tower": "9**9**9**9",
    }  # fmt: skip
    for name, cell in cells.items():
        yield text("number", name, column("Strain (mm/mm)", [cell] * 20))
        yield text("number", f"{name} in a track", ["t,x,y", *(f"{t},{cell},{cell}" for t in T)])


def times() -> Iterator[Hostile]:
    head = "Time (s),Strain (mm/mm),Stress (Pa)"
    sequences = {
        "constant": [1.0] * 20, "falling": list(range(20, 0, -1)), "shuffled": list(np.random.default_rng(1).permutation(20)),
        "not a number": ["nan"] * 20, "words": ["noon"] * 20, "two alternating": [0, 1] * 10,
    }  # fmt: skip
    for name, sequence in sequences.items():
        yield text("time", name, [head, *(f"{t},{row}" for t, row in zip(sequence, ROWS))])
        if name not in ("falling", "shuffled"):  # tracks are sorted by time
            yield text("time", f"{name} of a track", ["t,x,y", *(f"{t},{row.partition(',')[2]}" for t, row in zip(sequence, TRACK[1:]))])
    yield text("time", "milliseconds taken as s", ["t,x,y", *(f"{1e3 * t},{row.partition(',')[2]}" for t, row in zip(T, TRACK[1:]))])
    yield text("time", "frames without a rate", ["frame,x,y", *(f"{i},{i},{i * i}" for i in range(20))])
    yield text("time", "a frame rate of zero", ["frame,x,y", *(f"{i},{i},{i * i}" for i in range(20))], frame_rate=0.0)


def channels() -> Iterator[Hostile]:
    strain = [round(0.01 * i, 4) for i in range(20)]
    stresses = {
        "zero": [0] * 20, "constant": [5e4] * 20, "of the wrong sign": [-1e4 * i for i in range(20)], "beyond float": ["1e400"] * 20,
        "one number": ["", *[""] * 18, 5], "two numbers": [1, 2, *[""] * 18],
    }  # fmt: skip
    for name, stress in stresses.items():
        yield text("stress", name, column("Strain (mm/mm)", strain, rows=stress))
    paths = {
        "zero": [0] * 20, "constant": [0.2] * 20, "below -1": [-0.5 - 0.05 * i for i in range(20)], "thousandfold":
        [100 * i for i in range(20)],
        "percent without a unit": [5 * i for i in range(20)], "beyond float": [1e300 * i for i in range(20)],
    }  # fmt: skip
    for name, path in paths.items():
        title = "Strain" if "percent" in name else "Strain (mm/mm)"
        yield text("strain", name, column(title, path))
    yield text("strain", "shuffled", column("Stretch", list(1 + 0.1 * np.random.default_rng(0).permutation(20))))
    yield text("strain", "a stretch of zero", column("Stretch", [0.0] * 10 + [1.0] * 10))
    for titles in ("a,b", "Temperature,Humidity", "Time (s),Temperature (°C)", "Stress (Pa),Force (N)", "Strain (%),Strain 2 (%)"):
        yield text("titles", titles, [titles, *ROWS])


def units() -> Iterator[Hostile]:
    for unit in (
        "parsec/fortnight",
        "kg",
        "s",
        "m^9^9^9",
        "MPa**99999999",
        "__import__('os').system('touch evil')",
        "1e999 Pa",
        "🦆",
        "Pa Pa Pa",
    ):
        yield text("unit", f"option {unit}", column("Strain (mm/mm)", [0.01 * i for i in range(20)]), units={"nominal_stress": unit})
    for unit in ("kg", "V", "s", "mm^2", "m^999999999"):
        yield text("unit", f"strain in {unit}", TENSILE, units={"strain": unit})
    for unit in ("kg", "m/s", "mm^99"):
        yield text("unit", f"positions in {unit}", TRACK, units={"x": unit})
        yield text("unit", f"times in {unit}", TRACK, units={"time": unit})
    yield text("unit", "an axis without a unit", ["t (s),x (mm),y", *TRACK[1:]])
    yield text("unit", "no unit of a force", column("Extension (mm)", list(range(20)), "Force"), specimen=Specimen("9 mm", "9 mm", "9 mm"))


def sizes() -> Iterator[Hostile]:
    load = column("Extension (mm)", list(range(20)), "Load (N)")
    yield text("size", "none", load)
    for size in ("0 mm", "-5 mm", "50", "mm", "", " ", "nan mm", "1e999 mm", "5 s", "5 mm mm", "../mm", "1.2.3 mm"):
        if size.strip():
            yield text("size", f"length {size}", load, specimen=Specimen(size, "10 mm", "2 mm"))
    yield text("size", "no thickness", load, specimen=Specimen("50 mm", "10 mm"))
    yield text("size", "a unit that is none above the table", ["Length,50,seconds", *load])
    yield text("size", "a shear without a face", column("Displacement (mm)", list(range(20)), "Load (N)"), mode="simple_shear",
               specimen=Specimen(thickness="20 mm"))  # fmt: skip
    yield text("size", "two axes without sizes",
            ["Extension 1 (mm),Extension 2 (mm),Load 1 (N),Load 2 (N)", *(f"{i},{i},{i},{i}" for i in range(9))],
               mode="biaxial")  # fmt: skip


def choices() -> Iterator[Hostile]:
    options: dict[str, dict[str, Any]] = {
        "kind": {"kind": "magic"}, "mode": {"mode": "torsion"}, "up": {"up": "x"}, "an unknown quantity": {"columns": {"warp": "a"}},
        "an absent title": {"columns": {"force": "Channel 9"}}, "no axis 2": {"mode": "biaxial"},
        "rows of words": {"preparation": Preparation("a:b")},
        "rows beyond": {"preparation": Preparation("500:600")}, "rows negative": {"preparation": Preparation("-5:-1")},
        "a step of zero": {"preparation": Preparation("::0")}, "means of none": {"preparation": Preparation(average=0)},
        "means of all": {"preparation": Preparation(average=20)}, "a zero of words": {"preparation": Preparation(zero="now")},
        "a preload in kg": {"preparation": Preparation(zero="5 kg")}, "a preload too large": {"preparation": Preparation(zero="5 TPa")},
        "a preload that is a force": {"preparation": Preparation(zero="5 N")}, "cycles": {"preparation": Preparation(cycles="all")},
        "a step": {"step": "0.01"}, "a sheet of text": {"sheet": "Sheet1"}, "a sheet of dots": {"sheet": "../../etc"},
        "an unknown recording": {"held_out": ["b"]}, "all held out": {"held_out": ["a"]}, "a path held out": {"held_out": ["../a"]},
        "a density of zero": {"density": -1.0}, "a modulus below zero": {"young": -5.0}, "a ratio of 0.7": {"poisson": 0.7},
        "a mass of a test": {"mass": 1.0}, "pixels of a test": {"scale": 0.1}, "a track of rows": {"kind": "track", "step": "0.1"},
        "a body without positions": {"kind": "body"}, "a track without positions": {"kind": "track"},
    }  # fmt: skip
    for name, chosen in options.items():
        yield text("option", name, TENSILE, **chosen)
    for name, chosen in {
        "scale of zero": {"scale": 0.0}, "scale that is none": {"scale": float("nan")}, "a mass below zero": {"mass": -1.0,
        "diameter": 0.1},
        "a mass in grams": {"mass": 57.0, "diameter": 0.06}, "a diameter of zero": {"mass": 1.0, "diameter": 0.0},
        "an absent point": {"point": "nose"},
        "a gauge length": {"specimen": Specimen("5 mm")}, "slack": {"preparation": Preparation(zero="toe")},
        "y down": {"y_down": True}, "millimetres": {"scale": 1000.0},
    }.items():  # fmt: skip
        yield text("option", name, TRACK, **chosen)
    yield text(
        "option", "a relaxation without its step", ["Time (s),Relaxation modulus (Pa)", *(f"{i + 1},{9 - 0.1 * i}" for i in range(9))]
    )
    for step in ("0", "-1", "nan", "1 mm", "__import__"):
        yield text(
            "option", f"a step of {step}", ["Time (s),Relaxation modulus (Pa)", *(f"{i + 1},{9 - 0.1 * i}" for i in range(9))], step=step
        )


def curves() -> Iterator[Hostile]:
    for titles, sign in (
        ("Frequency (Hz),Storage modulus (Pa),Loss modulus (Pa)", -1),
        ("Time (s),Compliance (1/Pa)", -1),
        ("Shear rate (1/s),Shear stress (Pa)", -1),
        ("Shear rate (1/s),Viscosity (Pa s)", -1),
        ("Time (s),Angle (deg)", 1),
        ("Time (s),Theta (rad)", 1),
    ):
        rows = [",".join(f"{sign * (i + 1) * (j + 1)}" for j in range(titles.count(",") + 1)) for i in range(9)]
        yield text("curve", titles, [titles, *rows])


def archive(members: dict[str, bytes]) -> bytes:
    memory = io.BytesIO()
    with zipfile.ZipFile(memory, "w", zipfile.ZIP_DEFLATED) as made:
        for name, content in members.items():
            made.writestr(name, content)
    return memory.getvalue()


def spreadsheets() -> Iterator[Hostile]:
    whole = archive(book('<c r="A1"><v>1</v></c>'))
    contents = {
        "no archive": b"PK\x03\x04" + b"x" * 100, "cut": whole[: len(whole) // 2], "no workbook": archive({"a.txt": b"hello"}),
        "an empty archive": archive({}), "a path outside": archive({"../../evil.txt": b"evil"}), "one cell": whole,
        "a far cell": archive(book('<c r="XFD1048576"><v>1</v></c>')), "no XML": archive(book("") | {"xl/worksheets/sheet1.xml": b"<<<"}),
        "entities": archive(book("") | {"xl/worksheets/sheet1.xml": b'<!DOCTYPE x [<!ENTITY a "b">]><worksheet>&a;&a;</worksheet>'}),
        "an old header": b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(600), "an old header alone": b"\xd0\xcf\x11\xe0",
        "an old random file": b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + np.random.default_rng(0).bytes(2000),
        "a bomb": archive({"xl/worksheets/sheet1.xml": b" " * (80 << 20)}),
    }  # fmt: skip
    for name, content in contents.items():
        yield Hostile("spreadsheet", name, content, {}, "a.xlsx")


def book(cells: str) -> dict[str, bytes]:
    """The members of a workbook with one sheet."""
    kinds = "application/vnd.openxmlformats-officedocument.spreadsheetml"
    space, links = "http://schemas.openxmlformats.org/{}", "http://schemas.openxmlformats.org/officeDocument/2006/relationships"
    main, package = space.format("spreadsheetml/2006/main"), space.format("package/2006")

    def override(part: str, kind: str) -> str:
        return f'<Override PartName="/xl/{part}.xml" ContentType="{kinds}.{kind}+xml"/>'

    def relation(kind: str, target: str) -> str:
        entry = f'<Relationship Id="r1" Type="{links}/{kind}" Target="{target}"/>'
        return f'<Relationships xmlns="{package}/relationships">{entry}</Relationships>'

    parts = override("workbook", "sheet.main") + override("worksheets/sheet1", "worksheet")
    sheet = '<sheets><sheet name="a" sheetId="1" r:id="r1"/></sheets>'
    members = {
        "[Content_Types].xml": f'<Types xmlns="{package}/content-types">{parts}</Types>',
        "_rels/.rels": relation("officeDocument", "xl/workbook.xml"),
        "xl/workbook.xml": f'<workbook xmlns="{main}" xmlns:r="{links}">{sheet}</workbook>',
        "xl/_rels/workbook.xml.rels": relation("worksheet", "worksheets/sheet1.xml"),
        "xl/worksheets/sheet1.xml": f'<worksheet xmlns="{main}"><sheetData><row r="1">{cells}</row></sheetData></worksheet>',
    }
    return {name: content.encode() for name, content in members.items()}


def motions() -> Iterator[Hostile]:
    points = {
        "never seen": ["-9999,-9999"] * 20, "always zero": ["0,0"] * 20, "at one place": ["1,2"] * 20, "seen twice": ["1,2",
        "2,3", *[","] * 18],
        "of words": ["left,right"] * 20,
    }  # fmt: skip
    for name, rows in points.items():
        yield text("motion", name, ["t,x,y", *(f"{t},{row}" for t, row in zip(T, rows))])
    yield text("motion", "pixels", ["t,x (px),y (px)", *TRACK[1:]])
    heads = {
        "OptiTrack without names": ["Format Version,1.23,Length Units,Meters",
        "Frame,Time,X,Y,Z", *(f"{i},{t},{i},{i},{i}" for i, t in enumerate(T))],
        "OptiTrack without rows": ["Format Version,1.23,Length Units,Meters", ",Name,a,a,a", "Frame,Time,X,Y,Z"],
        "OptiTrack in parsecs": ["Format Version,1.23,Length Units,Pa", ",Name,a,a,a", ",,Position,Position,Position", "Frame,Time,X,Y,Z",
                                 *(f"{i},{t},{i},{i},{i}" for i, t in enumerate(T))],
        "OptiTrack alone": ["Format Version"], "Vicon without a rate": ["Trajectories", "fast", ",,a,,", "Frame,Sub Frame,X,Y,Z",
        ",,mm,mm,mm", "1,0,1,1,1"],
        "Vicon with a rate of zero": ["Trajectories", "0", ",,a,,", "Frame,Sub Frame,X,Y,Z",
        ",,mm,mm,mm", *(f"{i},0,1,1,1" for i in range(5))],
        "Vicon alone": ["Trajectories"], "DeepLabCut alone": ["scorer,a,a,a"], "DeepLabCut without parts": ["scorer,a", "bodyparts,b",
        "coords,x", "0,1"],
        "TRC alone": ["PathFileType\t4"], "TRC cut": ["PathFileType\t4\t(X/Y/Z)\ta.trc", "DataRate\tUnits", "30\tmm", "Frame#\tTime\ta"],
    }  # fmt: skip
    for name, lines in heads.items():
        yield text("motion", name, lines)
    for name, content in {
        "garbage": b"\x02P" + bytes(600),
        "empty": b"",
        "cut": b"\x02",
        "text": b"hello",
        "random": np.random.default_rng(3).bytes(1500),
    }.items():
        yield Hostile("motion", f"C3D, {name}", content, {}, "a.c3d")
    grid = [(i, 0.1 * (i % 3), 0.1 * (i // 3 % 3), 0.1 * (i // 9)) for i in range(27)]
    cube = ["t,id,x,y,z", *(f"{t},{i},{x},{y},{z}" for t in T[:5] for i, x, y, z in grid)]
    yield text("body", "without a material", cube)
    for name, chosen in {"density of zero": {"density": 0.0}, "density below zero": {"density": -1.0}, "modulus of zero": {"young": 0.0},
                         "ratio of 0.5": {"poisson": 0.5}, "volume below zero": {"volume": -1.0}, "volume of a house": {"volume": 500.0},
                         "modulus of NaN": {"young": float("nan")}, "floor at infinity": {"floor": float("inf")}}.items():  # fmt: skip
        yield text("body", name, cube, **({"density": 1000.0, "young": 1e5} | chosen))
    material = {"density": 1000.0, "young": 1e5}
    yield text(
        "body", "of few points", [line for line in cube if not line.split(",")[1].isdigit() or int(line.split(",")[1]) < 5], **material
    )
    yield text("body", "in a plane", [line for line in cube if not line.split(",")[1].isdigit() or int(line.split(",")[1]) < 9], **material)
    yield text("body", "of two coordinates", [line.rpartition(",")[0] for line in cube], **material)
    yield text("body", "of one frame", [line for line in cube if line[0] == "t" or line.startswith("0.0,")], **material)


def all_of_them() -> list[Hostile]:
    made: list[Hostile] = []
    for kind in (no_tables, encodings, quotes, numbers, times, channels, units, sizes, choices, curves, spreadsheets, motions):
        made += kind()
    return made
