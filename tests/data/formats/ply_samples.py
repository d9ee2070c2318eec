"""PLY files for the tests: text and both byte orders, comments, and an element of lists before the vertices."""

import struct
from pathlib import Path

import numpy as np

NAMES = {"f4": "float", "f8": "double", "i4": "int", "u1": "uchar"}


def write_ply(path: Path, vertices: np.ndarray, *, form: str = "little", comments=(), faces=None) -> Path:
    """Write vertices, and before them the faces, as a PLY file; `form` is text, little or big."""
    order = ">" if form == "big" else "<"
    kind = "ascii" if form == "text" else f"binary_{form}_endian"
    head = ["ply", f"format {kind} 1.0", *(f"comment {comment}" for comment in comments)]
    body = b""
    if faces is not None:
        head += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        for face in faces:
            text = " ".join(map(str, (len(face), *face))) + "\n"
            body += text.encode() if form == "text" else struct.pack(f"{order}B{len(face)}i", len(face), *face)
    names = vertices.dtype.names
    head += [f"element vertex {len(vertices)}", *(f"property {NAMES[vertices.dtype[n].str[1:]]} {n}" for n in names), "end_header\n"]
    if form == "text":
        body += "".join(" ".join(repr(row[name].item()) for name in names) + "\n" for row in vertices).encode()
    else:
        body += vertices.astype([(n, order + vertices.dtype[n].str[1:]) for n in names]).tobytes()
    path.write_bytes("\n".join(head).encode() + body)
    return path
