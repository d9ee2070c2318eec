"""A learned law as a header of plain C99: no dependency beside <math.h>, in float and in double.

The functions are those of `physics.laws.neural.networks` and `bounded`, written out for one F. Matrices are nine numbers, row by row.
"""

import os
import re
from pathlib import Path
from typing import Any

import numpy as np

from neuido.data.files.writing import write_text
from neuido.errors import UserError
from neuido.export.materials.learned import learned_laws
from neuido.physics.laws.neural.bounded import BoundedElastic, FullPlastic
from neuido.physics.laws.neural.bounded_kernels import EXPONENT, RANGE, SHORTEST, SPREAD, T1, VOLUME_FLOOR
from neuido.physics.laws.neural.network_kernels import COARSE, DELTA, FINE, LINEAR, LODE
from neuido.physics.laws.neural.networks import RAW_GAIN, RawElastic, RawPlastic
from neuido.physics.laws.neural.return_kernels import CRUSH, ROOT, SKEW

PER_LINE = 6
"""Numbers in a line of an array."""

ALGEBRA = """
static inline void NAME_mulS(const REAL a[9], const REAL b[9], REAL out[9]) {
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            out[3 * i + j] = a[3 * i] * b[j] + a[3 * i + 1] * b[3 + j] + a[3 * i + 2] * b[6 + j];
}

/* K = cofactor matrix of F; returns det F */
static inline REAL NAME_cofactorS(const REAL F[9], REAL K[9]) {
    for (int i = 0; i < 3; ++i) {
        const REAL *a = F + 3 * ((i + 1) % 3), *b = F + 3 * ((i + 2) % 3);
        for (int j = 0; j < 3; ++j)
            K[3 * i + j] = a[(j + 1) % 3] * b[(j + 2) % 3] - a[(j + 2) % 3] * b[(j + 1) % 3];
    }
    return K[0] * F[0] + K[1] * F[1] + K[2] * F[2];
}

/* trace l, deviator A and its norm q of the left Hencky strain ln V, by a series to the seventh order */
static inline void NAME_hencky_strainS(const REAL F[9], REAL *l, REAL A[9], REAL *q) {
    REAL G[9], e[9], m[9], K[9], n[9], h[9], t[9], h2[9], u[9];
    for (int i = 0; i < 9; ++i) G[i] = F[i] - (i % 4 == 0);
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {
            REAL square = G[3 * i] * G[3 * j] + G[3 * i + 1] * G[3 * j + 1] + G[3 * i + 2] * G[3 * j + 2];
            e[3 * i + j] = C(0.5) * (G[3 * i + j] + G[3 * j + i] + square);
        }
    for (int i = 0; i < 9; ++i) m[i] = e[i] + (i % 4 == 0);
    const REAL det = NAME_cofactorS(m, K);
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) n[3 * i + j] = K[3 * j + i] / det;
    NAME_mulS(e, n, t);
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) h[3 * i + j] = C(0.5) * (t[3 * i + j] + t[3 * j + i]);
    NAME_mulS(h, h, h2);
    for (int i = 0; i < 9; ++i) t[i] = C(0.2) * (i % 4 == 0) + h2[i] / C(7.0);
    NAME_mulS(h2, t, u);
    for (int i = 0; i < 9; ++i) u[i] += (i % 4 == 0) / C(3.0);
    NAME_mulS(h2, u, t);
    NAME_mulS(h, t, u);
    for (int i = 0; i < 9; ++i) A[i] = h[i] + u[i];
    *l = A[0] + A[4] + A[8];
    for (int i = 0; i < 9; i += 4) A[i] -= *l / C(3.0);
    REAL square = C(DELTA) * C(DELTA);
    for (int i = 0; i < 9; ++i) square += A[i] * A[i];
    *q = sqrtS(square);
}

static inline void NAME_strain_featuresS(REAL l, const REAL A[9], REAL q, REAL x[9]) {
    REAL K[9];
    const REAL d = NAME_cofactorS(A, K);
    x[0] = asinhS(l / C(FINE)) / 4;
    x[1] = asinhS(l / C(COARSE));
    x[2] = asinhS(q / C(FINE)) / 4;
    x[3] = asinhS(q / C(COARSE));
    x[4] = l / sqrtS(l * l + q * q);
    x[5] = C(LODE) * (d / q / q / q);
    x[6] = C(LINEAR) * l;
    x[7] = C(LINEAR) * q;
    x[8] = C(LINEAR) * (d / q / q);
}
"""

NETWORK = """
static inline void NAME_KIND_networkS(const REAL x[9], REAL y[OUTPUTS]) {
    REAL h1[HIDDEN], h2[HIDDEN];
    for (int i = 0; i < HIDDEN; ++i) {
        REAL z = NAME_KIND_b1[i];
        for (int j = 0; j < 9; ++j) z += NAME_KIND_W1[9 * i + j] * x[j];
        h1[i] = z / (1 + expS(-z));
    }
    for (int i = 0; i < HIDDEN; ++i) {
        REAL z = NAME_KIND_b2[i];
        for (int j = 0; j < HIDDEN; ++j) z += NAME_KIND_W2[HIDDEN * i + j] * h1[j];
        h2[i] = z / (1 + expS(-z));
    }
    for (int i = 0; i < OUTPUTS; ++i) {
        y[i] = NAME_KIND_b3[i];
        for (int j = 0; j < HIDDEN; ++j) y[i] += NAME_KIND_W3[HIDDEN * i + j] * h2[j];
    }
}
"""

RAW_ELASTIC = """
/* Kirchhoff stress [Pa] of a deformation gradient */
static inline void NAME_stressS(const REAL F[9], REAL tau[9]) {
    REAL x[9];
    for (int i = 0; i < 9; ++i) x[i] = C(RAW_GAIN) * (F[i] - (i % 4 == 0));
    NAME_elastic_networkS(x, tau);
    for (int i = 0; i < 9; ++i) tau[i] *= C(ELASTIC_SCALE);
}
"""

RAW_PLASTIC = """
/* corrected deformation gradient of a trial one */
static inline void NAME_correctedS(const REAL F[9], REAL out[9]) {
    REAL x[9], y[9];
    for (int i = 0; i < 9; ++i) x[i] = C(RAW_GAIN) * (F[i] - (i % 4 == 0));
    NAME_plastic_networkS(x, y);
    for (int i = 0; i < 9; ++i) out[i] = F[i] + C(PLASTIC_SCALE) * y[i];
}
"""

OBJECTIVE_ELASTIC = """
/* Kirchhoff stress [Pa] of a deformation gradient */
static inline void NAME_stressS(const REAL F[9], REAL tau[9]) {
    REAL l, q, A[9], A2[9], x[9], c[4];
    NAME_hencky_strainS(F, &l, A, &q);
    NAME_strain_featuresS(l, A, q, x);
    NAME_elastic_networkS(x, c);
    NAME_mulS(A, A, A2);
    const REAL a = A2[0] + A2[4] + A2[8];
    for (int i = 0; i < 9; ++i) {
        const REAL one = (i % 4 == 0);
        tau[i] = C(ELASTIC_SCALE) * ((c[0] * l + c[3] * a / q) * one + c[1] * A[i] + c[2] / q * (A2[i] - a / C(3.0) * one));
    }
}
"""

RETURN_MAP = """
/* corrected deformation gradient of a trial one */
static inline void NAME_correctedS(const REAL F[9], REAL out[9]) {
    REAL l, q, A[9], x[9], c[COUNT], D[9], Y[9], E[9], t[9];
    NAME_hencky_strainS(F, &l, A, &q);
    NAME_strain_featuresS(l, A, q, x);
    NAME_plastic_networkS(x, c);
    const REAL radius = C(PLASTIC_SCALE) * c[0] + c[1] * fmaxS(-l, 0);
    const REAL f = fminS(fmaxS(1 - radius / q, 0), 1);
    DIRECTION
    for (int i = 0; i < 9; ++i) Y[i] = C(-0.25) * f * D[i];
    for (int i = 0; i < 9; ++i) E[i] = (i % 4 == 0) + Y[i] / 4;
    for (int k = 3; k > 0; --k) { /* exp(4 Y): a Taylor polynomial of degree four, squared twice */
        NAME_mulS(Y, E, t);
        for (int i = 0; i < 9; ++i) E[i] = (i % 4 == 0) + t[i] / k;
    }
    NAME_mulS(E, E, t);
    NAME_mulS(t, t, E);
    NAME_mulS(E, F, out);
    const REAL shrink = expS(-u / C(3.0));
    for (int i = 0; i < 9; ++i) out[i] *= shrink;
}
"""

TENSION = "fminS(fmaxS(l - C(PLASTIC_SCALE) * c[2], 0), l)"

OBJECTIVE_PLASTIC = RETURN_MAP.replace("COUNT", "3").replace(
    "DIRECTION",
    f"""const REAL u = l > 0 ? {TENSION} : 0;
    for (int i = 0; i < 9; ++i) D[i] = A[i];""",
)

FULL_PLASTIC = RETURN_MAP.replace("COUNT", "4").replace(
    "DIRECTION",
    f"""const REAL u = l > 0 ? {TENSION} : fminS(fmaxS(l + C(CRUSH) * C(PLASTIC_SCALE) * c[2], l), 0);
    const REAL lean = C(ROOT) * C(SKEW) * c[3] / sqrtS(1 + c[3] * c[3]) / q;
    NAME_mulS(A, A, t);
    const REAL mean = (t[0] + t[4] + t[8]) / C(3.0);
    for (int i = 0; i < 9; ++i) D[i] = A[i] + lean * (t[i] - mean * (i % 4 == 0));""",
)

BOUNDED_ELASTIC = """
/* Kirchhoff stress [Pa] of a deformation gradient */
static inline void NAME_stressS(const REAL F[9], REAL tau[9]) {
    REAL l, q, A[9], x[9], c[4], B[9], K[9], G[9], A2[9], M[9], H[9], t[9];
    NAME_hencky_strainS(F, &l, A, &q);
    const REAL s = fminS(C(RANGE) / sqrtS(l * l + q * q), 1);
    for (int i = 0; i < 9; ++i) B[i] = s * A[i];
    NAME_strain_featuresS(s * l, B, s * q, x);
    NAME_elastic_networkS(x, c);
    const REAL lam = C(ELASTIC_SCALE) * expS(fminS(fmaxS(c[0], C(-EXPONENT)), C(EXPONENT)));
    const REAL d = C(ELASTIC_SCALE) * expS(fminS(fmaxS(c[1], C(-EXPONENT)), C(EXPONENT)));
    const REAL J = NAME_cofactorS(F, K);
    if (J < 0) { /* inverted: pulled together, most along its shortest direction */
        REAL sum = 0;
        for (int i = 0; i < 9; ++i) sum += K[i] * K[i];
        sum = fmaxS(sum, C(SHORTEST));
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) {
                const REAL square = K[3 * i] * K[3 * j] + K[3 * i + 1] * K[3 * j + 1] + K[3 * i + 2] * K[3 * j + 2];
                tau[3 * i + j] = d * square / sum + (i == j) * lam * log1pS(-J);
            }
        return;
    }
    const REAL root = sqrtS(1 + c[2] * c[2]) + sqrtS(1 + c[3] * c[3]);
    const REAL p = C(SPREAD) * c[2] / root, r = C(SPREAD) * c[3] / root;
    NAME_mulS(A, A, A2);
    const REAL mean = (A2[0] + A2[4] + A2[8]) / C(3.0);
    for (int i = 0; i < 9; ++i) {
        const REAL one = (i % 4 == 0);
        H[i] = A[i] + l / C(3.0) * one;
        M[i] = one + p * C(T1) * A[i] / q + r * 3 * (A2[i] - mean * one) / (q * q);
        G[i] = F[i] - one;
    }
    REAL volume; /* det F - 1 without loss of digits */
    {
        REAL L[9];
        const REAL trace = G[0] + G[4] + G[8];
        NAME_mulS(G, G, t);
        volume = trace + C(0.5) * (trace * trace - (t[0] + t[4] + t[8])) + NAME_cofactorS(G, L);
    }
    const REAL ln = J > C(0.5) ? log1pS(fmaxS(volume, C(-0.5))) : logS(fmaxS(J, C(VOLUME_FLOOR)));
    NAME_mulS(M, H, t);
    for (int i = 0; i < 9; ++i) tau[i] = d * t[i] + (i % 4 == 0) * lam * ln;
}
"""

TANGENT = """
/* d tau / d F of NAME_stress by central differences, row 9 i + j: d tau[i] / d F[j] [Pa] */
static inline void NAME_tangent(const double F[9], double out[81]) {
    const double step = 1e-6;
    for (int j = 0; j < 9; ++j) {
        double up[9], down[9], above[9], below[9];
        for (int i = 0; i < 9; ++i) up[i] = down[i] = F[i];
        up[j] += step;
        down[j] -= step;
        NAME_stress(up, above);
        NAME_stress(down, below);
        for (int i = 0; i < 9; ++i) out[9 * i + j] = (above[i] - below[i]) / (2 * step);
    }
}
"""
VISCOSITY = """/* shear viscosity [Pa s]: beside the stress of these functions, the Cauchy stress 2 NAME_viscosity D */
static const double NAME_viscosity = {:.9g};
"""
CONSTANTS = {
    "DELTA": DELTA, "FINE": FINE, "COARSE": COARSE, "LODE": LODE, "LINEAR": LINEAR, "RAW_GAIN": RAW_GAIN, "RANGE": RANGE,
    "EXPONENT": EXPONENT, "SHORTEST": SHORTEST, "SPREAD": SPREAD, "T1": T1, "VOLUME_FLOOR": VOLUME_FLOOR,
    "CRUSH": CRUSH, "ROOT": ROOT, "SKEW": SKEW,
}  # fmt: skip


def write_c(source: Any, path: str | os.PathLike, *, name: str = "neuido", tangent: bool = False) -> Path:
    """Write a learned law as a C header.

    It has `NAME_stress(F, tau)` and `NAME_corrected(F, out)` for double, and `NAME_stressf` and `NAME_correctedf` for float. A substep
    corrects the trial F first, and takes the stress of the corrected one. The viscosity of a law that has one is `NAME_viscosity`.

    Args:
        source: As for `learned_laws`.
        path: File ending in .h.
        name: Prefix of all names: a letter, then letters, digits and `_`.
        tangent: Whether `NAME_tangent(F, out)` is added, d tau/d F in double by central differences.

    Raises:
        UserError: There is no learned law, another ending, or an impossible name.
    """
    target = Path(path).expanduser()
    if target.suffix != ".h":
        raise UserError(f"path = {path}: a C header ends in .h")
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,63}", name):
        raise UserError(f"name = {name!r}: a prefix in C starts with a letter and has letters, digits and _ (64 at most)")
    write_text(target, c_text(*learned_laws(source), name=name, tangent=tangent))
    return target


def c_text(elastic: Any, plastic: Any, *, name: str = "neuido", tangent: bool = False) -> str:
    """Return the header of a law."""
    raw = isinstance(elastic, RawElastic)
    hidden = elastic.tensors()[0].shape[-2]
    stress = RAW_ELASTIC if raw else BOUNDED_ELASTIC if isinstance(elastic, BoundedElastic) else OBJECTIVE_ELASTIC
    corrected = RAW_PLASTIC if isinstance(plastic, RawPlastic) else FULL_PLASTIC if isinstance(plastic, FullPlastic) else OBJECTIVE_PLASTIC
    networks = [
        NETWORK.replace("KIND", kind).replace("HIDDEN", str(law.tensors()[0].shape[-2])).replace("OUTPUTS", str(law.outputs))
        for kind, law in (("elastic", elastic), ("plastic", plastic))
    ]
    both = ALGEBRA + "".join(networks) + stress + corrected
    scales = {"ELASTIC_SCALE": elastic.scale, "PLASTIC_SCALE": plastic.scale}
    parts = [
        f"/* {type(elastic).__name__} and {type(plastic).__name__} with {hidden} hidden units, written by neuido.",
        "   F: deformation gradient [-], nine numbers row by row. Stress: Kirchhoff [Pa]. A substep takes the stress of the corrected F.",
        "   Functions that end in f are for float. Nothing is allocated; all functions may run in several threads. */",
        f"#ifndef {name.upper()}_LAW_H\n#define {name.upper()}_LAW_H\n#include <math.h>\n",
        *([] if elastic.viscosity is None else [VISCOSITY.format(float(elastic.viscosity[0]))]),
        *(_arrays(kind, law) for kind, law in (("elastic", elastic), ("plastic", plastic))),
        _of_type(both, "double", "", {**CONSTANTS, **scales}),
        _of_type(both, "float", "f", {**CONSTANTS, **scales}),
    ]
    text = "\n".join(parts) + (TANGENT if tangent else "") + "#endif\n"
    return re.sub(r"NAME(?=_)", name, text)


def _of_type(text: str, real: str, suffix: str, constants: dict[str, float]) -> str:
    """Return the functions for `double` or `float`; `C(...)` is a constant of the type, and the suffix S that of its functions."""

    def constant(match: re.Match) -> str:
        sign, word = match[1], match[2]
        return _literal(sign, constants[word] if word in constants else float(word), suffix)

    text = re.sub(r"\bC\((-?)([A-Z0-9_]+|[0-9.]+)\)", constant, text)
    return re.sub(r"(?<=[a-z0-9])S(?=\()", suffix, text).replace("REAL", real)


def _literal(sign: str, value: float, suffix: str) -> str:
    digits = f"{value:.17g}" if not suffix else f"{value:.9g}"
    digits = digits if any(c in digits for c in ".en") else f"{digits}.0"
    return f"({sign}{digits}{suffix})"


def _arrays(kind: str, law: Any) -> str:
    lines = []
    for part, tensor in zip(("W1", "b1", "W2", "b2", "W3", "b3"), law.tensors()):
        values = tensor[0].detach().cpu().numpy()
        single = values.dtype == np.float32
        words = [f"{value:.9g}" if single else f"{value:.17g}" for value in values.reshape(-1)]
        words = [(word if any(c in word for c in ".en") else f"{word}.0") + ("f" if single else "") for word in words]
        rows = [", ".join(words[i : i + PER_LINE]) for i in range(0, len(words), PER_LINE)]
        head = f"static const {'float' if single else 'double'} NAME_{kind}_{part}[{values.size}]"
        lines.append(f"{head} = {{\n    " + ",\n    ".join(rows) + "};")
    return "\n".join(lines) + "\n"
