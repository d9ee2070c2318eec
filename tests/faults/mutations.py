"""Damaged and hostile versions of a file, each a function of the file and a seed alone."""

import io
import json
import random
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
import yaml

NUMBERS = [
    "nan", "NaN", "inf", "-inf", "Infinity", "1e400", "-1e400", "1e-400", "1e308", "1e38", "0", "-0.0", "-1", "1", "2", "255", "256",
    "4294967296", "9223372036854775807", "9223372036854775808", "-9223372036854775809", "1" * 40, "9" * 5000, "0x7f", "1_000", "1,5",
    "1.5.2", "+", "-", "", "null", "true", "~", '"1"', "[]", "{}", "1e", "1:60:60", "2001-99-99", "1e5 mm", "١٢", "１",
]  # fmt: skip
WORDS = [
    "../../evil", "/tmp/evil", "..", ".", "", " ", "~", "~root/x", "C:\\evil", "\\\\host\\share", "con", "a/b", "a\0b", "x" * 5000,
    "$x^{y$", "<script>alert(1)</script>", "%s%n", "{0.__class__}", "${env}", "é", "\u202egnp", "\ud800", "\ufeff", "😀", "\x1b[31m",
    "!!python/object/apply:os.system [echo]", "*a", "&a", "<<", "---", "...", "[", "{", "- ", "'", '"', ":", "#", "\t", "\r", "nan",
    "__class__", "__proto__", "-1", "None", "file:///etc/passwd", "http://example.invalid/x", "\u2028", "\x85",
]  # fmt: skip
VALUES: list[Any] = [
    None, True, False, 0, 1, -1, -1.5, 1e-320, 1e300, 10**30, 2**63, float("nan"), float("inf"), "", "nan", "1e400", "x" * 3000, "../evil",
    "/tmp/evil", [], {}, [[]], [None], {"a": 1}, {"": {}}, [1, 2, 3], [1.0, 0.0], [[[[]]]], "\ud800", "a\0b", "$x^{$",
    [[0, 0, 0], [1, 1, 1]], "2020-01-01", "1 mm", [True] * 3, [float("nan")] * 3, 3, "é", [1] * 50,
]  # fmt: skip
YAML_SNIPPETS = [
    "\na: &a [x, x, x, x, x, x, x, x, x]\nb: &b [*a, *a, *a, *a, *a, *a, *a, *a, *a]\n"
    "c: &c [*b, *b, *b, *b, *b, *b, *b, *b, *b]\nd: &d [*c, *c, *c, *c, *c, *c, *c, *c, *c]\n"
    "e: &e [*d, *d, *d, *d, *d, *d, *d, *d, *d]\nf: &f [*e, *e, *e, *e, *e, *e, *e, *e, *e]\ng: [*f, *f, *f, *f, *f, *f, *f, *f, *f]\n",
    "\na: &a [*a]\n", "\na: &a {<<: *a}\n", "\n<<: {name: b}\n", "\n<<: [1]\n", "\nwhen: 2001-99-99\n", "\nwhen: 2001-12-14 99:99:99\n",
    "\n? [a, b]\n: c\n", "\n? {a: b}\n: c\n", "\n!!python/object/apply:os.system ['echo']\n", "\na: !!binary '***'\n",
    "\na: !!set {a, b}\n", "\na: !!omap [a: 1]\n", "\na: !!int x\n", "\na: !!float y\n", "\na: !!timestamp z\n",
    "\n---\nb: 1\n", "\n...\n", "\n%YAML 9.9\n",
    "\na: " + "[" * 3000, "\na: " + "{a: " * 500, "\nnull: 1\n", "\n1: 1\n", "\n2001-01-01: 1\n", "\n.nan: 1\n", "\nname: a\nname: b\n",
    "\na: 0o99\n", "\na: 1_2_3\n", "\na: 190:20:30\n", "\na: 0b2\n", "\n\tb: 1\n", "\na: |9999999999999\n  x\n", "\na: !<x> 1\n", "\n@\n",
    "\na: " + "9" * 5000 + "\n", "\n" + "# " * 200 + "\n", "\n'a\n", '\n"\\ud800"\n', "\na: *missing\n",
]  # fmt: skip
ENCODINGS = ("utf-16", "utf-16-le", "utf-16-be", "utf-32", "utf-8-sig", "latin-1", "cp1252", "utf-7")
PICKLE = b"\x80\x04cos\nsystem\n(S'echo'\ntR."
MAGIC = [
    b"", b"\0", b"\0" * 100, b"PK\x03\x04", b"\x1f\x8b\x08", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff\xe0", b"ply\n", b"\x93NUMPY", b"{", b"[",
    b"%PDF-1.4", b"GIF89a", b"BM", PICKLE, b"II*\0", b"RIFF", b"\n", b"\xef\xbb\xbf", b"\xff\xfe",
]  # fmt: skip
TEXT = (".yaml", ".json", ".csv", ".txt", ".trc")
ZIPS = (".npz", ".xlsx", ".pt", ".ckpt", ".pth")

Mutate = Callable[[bytes, random.Random], bytes]


def mutated(data: bytes, suffix: str, rng: random.Random) -> tuple[str, bytes]:
    """Return the kind of a mutation and the content that it makes of a file; sometimes two mutations after one another."""
    kinds = kinds_of(suffix)
    names = []
    for _ in range(1 + (rng.random() < 0.2)):
        name = rng.choice(list(kinds))
        try:
            data = kinds[name](data, rng)
        except Exception:  # what a first mutation has made may not be of the format any more
            name, data = "flip", flip(data, rng)
        names.append(name)
    return "+".join(names), data


def kinds_of(suffix: str) -> dict[str, Mutate]:
    """Return the mutations that make sense for a file of this suffix."""
    kinds: dict[str, Mutate] = {"flip": flip, "truncate": truncate, "insert": insert, "delete": delete, "repeat": repeat, "magic": magic}
    if suffix in TEXT:
        kinds |= {"number": number, "numbers": numbers, "word": word, "line": line, "encoding": encoding}
    else:
        kinds |= {"integer": integer, "integers": integers}
    if suffix == ".json":
        kinds |= {"tree": json_tree, "trees": json_tree, "header-tree": json_tree}
    elif suffix == ".yaml":
        kinds |= {"tree": yaml_tree, "trees": yaml_tree, "snippet": yaml_snippet}
    elif suffix in ZIPS:
        kinds |= {"member": zip_member, "content": zip_content, "entry": zip_entry}
        if suffix == ".npz":
            kinds |= {"array": npz_array, "arrays": npz_array, "header": npz_header}
    elif suffix == ".npy":
        kinds |= {"array": npy_array}
    elif suffix == ".ply":
        kinds |= {"head": ply_header, "number": ply_header}
    elif suffix == ".safetensors":
        kinds |= {"tree": safetensors_tree, "trees": safetensors_tree}
    return kinds


def flip(data: bytes, rng: random.Random) -> bytes:
    out = bytearray(data or b"\0")
    for _ in range(rng.choice((1, 1, 2, 8, 64))):
        i = _place(len(out), rng)
        out[i] = rng.choice((0, 255, 127, out[i] ^ (1 << rng.randrange(8)), rng.randrange(256)))
    return bytes(out)


def truncate(data: bytes, rng: random.Random) -> bytes:
    return data[: _place(len(data) + 1, rng)]


def insert(data: bytes, rng: random.Random) -> bytes:
    i = _place(len(data) + 1, rng)
    return data[:i] + rng.choice((rng.randbytes(rng.choice((1, 4, 64))), *MAGIC)) + data[i:]


def delete(data: bytes, rng: random.Random) -> bytes:
    i = _place(len(data) + 1, rng)
    return data[:i] + data[i + rng.choice((1, 4, 16, 256)) :]


def repeat(data: bytes, rng: random.Random) -> bytes:
    i = _place(len(data) + 1, rng)
    part = data[i : i + rng.choice((1, 4, 16, 256))]
    return data[:i] + part * rng.choice((2, 2, 3, 100)) + data[i:]


def magic(data: bytes, rng: random.Random) -> bytes:
    start = rng.choice(MAGIC)
    return rng.choice((start, start + data, start + data[len(start) :], data + start, b""))


def integer(data: bytes, rng: random.Random) -> bytes:
    """Overwrite a whole number of a binary file."""
    size, code = rng.choice(((1, "B"), (2, "H"), (4, "I"), (8, "Q"), (4, "f"), (8, "d")))
    if code in "fd":
        new = struct.pack(f"<{code}", rng.choice((float("nan"), float("inf"), -1.0, 1e38, 0.0)))
    else:
        top = 256**size
        new = struct.pack(f"{rng.choice('<>')}{code}", rng.choice((0, 1, top - 1, top // 2, top // 2 - 1, 255, rng.randrange(top))))
    i = _place(max(1, len(data) - size), rng)
    return data[:i] + new + data[i + size :]


def integers(data: bytes, rng: random.Random) -> bytes:
    for _ in range(rng.randrange(2, 6)):
        data = integer(data, rng)
    return data


def number(data: bytes, rng: random.Random) -> bytes:
    found = list(re.finditer(rb"-?\d+(?:[.,]\d+)?(?:[eE][-+]?\d+)?", data))
    if not found:
        return flip(data, rng)
    one = rng.choice(found)
    return data[: one.start()] + rng.choice(NUMBERS).encode() + data[one.end() :]


def numbers(data: bytes, rng: random.Random) -> bytes:
    new = rng.choice(NUMBERS).encode()
    share = rng.choice((0.05, 0.5, 1.0))
    return re.sub(rb"-?\d+(?:[.,]\d+)?(?:[eE][-+]?\d+)?", lambda m: new if rng.random() < share else m[0], data)


def word(data: bytes, rng: random.Random) -> bytes:
    found = list(re.finditer(rb"[A-Za-z_][\w.]*", data))
    if not found:
        return insert(data, rng)
    one, new = rng.choice(found), rng.choice(WORDS).encode("utf-8", "surrogatepass")
    return data[: one.start()] + new + data[one.end() :]


def line(data: bytes, rng: random.Random) -> bytes:
    lines = data.split(b"\n")
    i, j = rng.randrange(len(lines)), rng.randrange(len(lines))
    kind = rng.randrange(8)
    if kind == 0:
        del lines[i]
    elif kind == 1:
        lines.insert(j, lines[i])
    elif kind == 2:
        lines[i], lines[j] = lines[j], lines[i]
    elif kind == 3:
        lines[i] = b" " * rng.choice((1, 2, 4)) + lines[i]
    elif kind == 4:
        lines[i:i] = [lines[i]] * 2000
    elif kind == 5:
        lines[i] = lines[i] * rng.choice((2, 300))
    elif kind == 6:
        return rng.choice((b"\r", b"\r\n", b"\n\n", b"")).join(lines)
    else:
        lines[i] = re.sub(rb"[,;\t]", rng.choice((b",", b";", b"\t", b" ", b",,", b'"', b"|")), lines[i])
    return b"\n".join(lines)


def encoding(data: bytes, rng: random.Random) -> bytes:
    text = data.decode("utf-8", "replace").replace("a", rng.choice("aaéß€"), 1)
    return text.encode(rng.choice(ENCODINGS), "replace")


def json_tree(data: bytes, rng: random.Random) -> bytes:
    content = _changed(json.loads(data), rng)
    text = json.dumps(content)
    if rng.random() < 0.1:  # a key twice
        text = re.sub(r'("\w+": )', r"\1null, \1", text, count=1)
    return text.encode("utf-8", "surrogatepass")


def yaml_tree(data: bytes, rng: random.Random) -> bytes:
    flat = len(data) < 50_000 and sum(data.count(c) for c in (b"[", b"{", b"- ", b"? ")) < 400  # libyaml recurses without a limit
    content = _changed(yaml.load(data, yaml.CSafeLoader if flat else yaml.SafeLoader), rng)  # noqa: S506 (both are safe)
    style = rng.choice((None, True, False))
    return yaml.dump(content, Dumper=yaml.CSafeDumper, sort_keys=False, default_flow_style=style).encode("utf-8", "surrogatepass")


def yaml_snippet(data: bytes, rng: random.Random) -> bytes:
    lines, snippet = data.decode("utf-8", "replace").split("\n"), rng.choice(YAML_SNIPPETS)
    if rng.random() < 0.6:
        return ("\n".join(lines) + snippet).encode()
    i = rng.randrange(len(lines))
    value = snippet.strip("\n").partition(": ")[2] or snippet.strip("\n")  # in place of a value
    lines[i] = re.sub(r":.*", lambda _: f": {value}", lines[i], count=1)
    return "\n".join(lines).encode("utf-8", "surrogatepass")


def _changed(content: Any, rng: random.Random) -> Any:
    """Change one place of a tree of mappings and lists, or two."""
    for _ in range(rng.choice((1, 1, 1, 2))):
        places = list(_places(content))
        if not places:
            return rng.choice(VALUES)
        holder, key = rng.choice(places)
        kind = rng.randrange(8)
        if kind == 0:
            del holder[key]
        elif kind == 1 and isinstance(holder, dict):
            holder[rng.choice([w for w in WORDS if "\ud800" not in w])] = holder.pop(key)
        elif kind == 1:
            holder.extend([holder[key]] * rng.choice((1, 3, 400)))
        elif kind == 2:
            holder[key] = [holder[key]]
        elif kind == 3:
            holder[key] = {"a": holder[key]}
        elif kind == 4:
            other, place = rng.choice(places)
            holder[key] = other.get(place) if isinstance(other, dict) else other[place] if place < len(other) else None
        elif kind == 5 and isinstance(holder[key], str):
            new = rng.choice(WORDS).replace("\ud800", "")
            holder[key] = new if rng.random() < 0.7 else holder[key] + new
        elif kind == 6 and isinstance(holder[key], int | float) and not isinstance(holder[key], bool):
            holder[key] = holder[key] * rng.choice((-1, 0, 1e3, 1e-3, 1e6, 1e30)) if abs(holder[key]) < 1e250 else 0
        else:
            holder[key] = rng.choice([v for v in VALUES if v != "\ud800"])
        content = json.loads(json.dumps(content)) if _plain(content) else content  # no part of the tree in two places
    return content


def _plain(content: Any) -> bool:
    try:
        json.dumps(content)
    except (TypeError, ValueError):
        return False
    return True


def _places(content: Any, depth: int = 0):
    if depth > 40:
        return
    keys = list(content) if isinstance(content, dict) else range(len(content)) if isinstance(content, list) else ()
    for key in keys:
        yield content, key
        yield from _places(content[key], depth + 1)


def zip_member(data: bytes, rng: random.Random) -> bytes:
    """Drop, repeat or rename a member of an archive."""
    members = _members(data)
    i = rng.randrange(len(members))
    kind = rng.randrange(4)
    if kind == 0:
        del members[i]
    elif kind == 1:
        members.append(members[i])
    elif kind == 2:
        names = ["../../evil.npy", "/tmp/evil.npy", "x.npy", "é.npy", "a" * 300, "x/", members[i][0] + ".npy"]
        members[i] = (rng.choice(names), members[i][1])
    else:
        members[i] = (members[i][0], rng.choice((b"", b"\0" * 10, PICKLE, members[0][1])))
    return _archive(members, rng)


def zip_content(data: bytes, rng: random.Random) -> bytes:
    """Damage what a member of an archive holds, so that its checksum is right."""
    members = _members(data)
    i = rng.randrange(len(members))
    change = rng.choice((flip, truncate, insert, delete, repeat, integer, integers))
    members[i] = (members[i][0], change(members[i][1], rng))
    return _archive(members, rng)


def zip_entry(data: bytes, rng: random.Random) -> bytes:
    """Damage the archive's own records: sizes, methods, flags, offsets."""
    starts = [m.start() for m in re.finditer(rb"PK[\x01\x03\x05\x07]", data)]
    at = rng.choice(starts) + rng.randrange(4, 46)
    return data[:at] + rng.choice((b"\0", b"\xff", b"\x01", b"\x63", b"\xff\xff\xff\xff", b"\x08")) + data[at + 1 :]


def npz_array(data: bytes, rng: random.Random) -> bytes:
    """Change the shape, the type or the values of an array."""
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    name = rng.choice(list(arrays))
    arrays[name] = _changed_array(arrays[name], rng)
    if rng.random() < 0.1:
        arrays[rng.choice(("t", "x", "extra"))] = np.arange(4)
    stream = io.BytesIO()
    rng.choice((np.savez, np.savez_compressed))(stream, **arrays)
    return stream.getvalue()


def npy_array(data: bytes, rng: random.Random) -> bytes:
    stream = io.BytesIO()
    np.save(stream, _changed_array(np.load(io.BytesIO(data), allow_pickle=False), rng))
    return stream.getvalue()


def _changed_array(array: np.ndarray, rng: random.Random) -> np.ndarray:
    array = np.array(array)
    kind = rng.randrange(9)
    if kind == 0 and array.size:
        array = array.astype(rng.choice(("f2", "f8", "i8", "u1", "c16", "S8", "U8", "?", "O", "M8[s]", ">f4", "f4,i4")), casting="unsafe")
    elif kind == 1:
        none = array[:0] if array.ndim else array
        array = rng.choice((array[..., None], none, array.reshape(-1), array[None], array.T, np.empty((0, 0, 3))))
    elif kind == 2 and array.ndim:
        array = np.concatenate([array, array], axis=rng.randrange(array.ndim))
    elif kind == 3 and array.ndim:
        array = np.take(array, range(max(0, array.shape[0] - 1)), axis=0)
    elif kind == 4:
        array = np.zeros((), array.dtype)
    elif array.size and array.dtype.kind in "fiu":
        flat = array.reshape(-1)
        with np.errstate(all="ignore"):
            values = np.array([np.nan, np.inf, -np.inf, 0, -1, 1e30, 1e-30, 3e38, 2**31, 1.0]).astype(array.dtype)
        flat[[rng.randrange(len(flat)) for _ in range(rng.choice((1, 1, 3, len(flat))))]] = rng.choice(list(values))
    return array


def npz_header(data: bytes, rng: random.Random) -> bytes:
    """Lie in an array's header: sizes that are not there, types, versions."""
    members = _members(data)
    i = rng.randrange(len(members))
    shape = rng.choice(("(1000000000,)", "(0,)", "(-1, 3)", "(4294967296, 4294967296)", "()", "(3, 3, 3, 3)", "(99999999999999999999,)",
                        "(1.5,)", "[3]", "((" * 100, "(True,)"))  # fmt: skip
    kind = rng.choice(("'<f4'", "'<f8'", "'|O'", "'<U9999'", "'|V8'", "'<M8[ns]'", "[('a', '<f4')]", "'<f16'", "'x'", "None",
                       "'<S100000000'"))  # fmt: skip
    head = f"{{'descr': {kind}, 'fortran_order': {rng.choice(('False', 'True', '0'))}, 'shape': {shape}, }}"
    head = (head + " " * (63 - (len(head) + 10) % 64) + "\n").encode("latin-1")
    start = b"\x93NUMPY" + bytes(rng.choice(((1, 0), (1, 0), (2, 0), (3, 0), (9, 9)))) + struct.pack("<H", len(head))
    members[i] = (members[i][0], start + head + members[i][1][128:])
    return _archive(members, rng)


def ply_header(data: bytes, rng: random.Random) -> bytes:
    head, end, rest = data.partition(b"end_header\n")
    new = ["element vertex -1", "element vertex 99999999999", "element vertex x", "element chunk 3",
           "property list uchar int vertex_indices", "property float packed_position", "property double x", "property float f_rest_0",
           "comment é", "format ascii 1.0", "obj_info x",
           "format binary_big_endian 1.0", "element face 1000000", "property list float float y", "element vertex 0", "format x 9",
           "property float x", "comment " + "x" * 2000, "element vertex 1\nproperty float x"]  # fmt: skip
    lines = head.split(b"\n")
    i = rng.randrange(len(lines))
    lines[i : i + rng.randrange(2)] = [rng.choice(new).encode("latin-1")]
    return b"\n".join(lines) + end + rest


def safetensors_tree(data: bytes, rng: random.Random) -> bytes:
    """Change the header of a safetensors file, its metadata, or the JSON inside of the metadata."""
    size = struct.unpack("<Q", data[:8])[0]
    content = json.loads(data[8 : 8 + size])
    own = content.get("__metadata__", {})
    key = rng.choice(list(own)) if own else ""
    if own and rng.random() < 0.6:
        try:
            own[key] = json.dumps(_changed(json.loads(own[key]), rng))
        except ValueError:
            own[key] = rng.choice(WORDS).replace("\ud800", "")
    else:
        content = _changed(content, rng)
    head = json.dumps(content).encode()
    return struct.pack("<Q", len(head)) + head + data[8 + size :]


def _members(data: bytes) -> list[tuple[str, bytes]]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return [(name, archive.read(name)) for name in archive.namelist()]


def _archive(members: list[tuple[str, bytes]], rng: random.Random) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as archive:
        for name, content in members:
            archive.writestr(zipfile.ZipInfo(name), content)
    return stream.getvalue()


def _place(count: int, rng: random.Random) -> int:
    """Return a place in a file, every second one among its first 200 bytes, where headers are."""
    return rng.randrange(min(count, 200) if rng.random() < 0.5 else count) if count > 0 else 0


def bomb(shape: tuple[int, ...], name: str = "x") -> bytes:
    """Return an archive of zeros that is a thousandth of what it unpacks to."""
    head = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}"
    head = (head + " " * (63 - (len(head) + 10) % 64) + "\n").encode()
    total, stream = 8 * int(np.prod(shape, dtype=object)), io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
            file.write(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head)
            block = bytes(1 << 24)
            while total > 0:
                total -= file.write(block[: min(total, len(block))])
    return stream.getvalue()


def png_bomb(width: int, height: int) -> bytes:
    """Return a PNG whose header and compressed zeros claim this size."""
    raw = zlib.compressobj(9)
    body = b"".join(raw.compress(b"\0" * (width + 1)) for _ in range(height)) + raw.flush()

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", body) + chunk(b"IEND", b"")
