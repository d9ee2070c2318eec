"""Write the JSON Schemas of docs/formats/schemas: `python docs/formats/make_schemas.py`.

Enumerations (laws, effects, modes, roles) come from the readers themselves; tests/test_docs.py checks that schema and
reader accept and refuse the same files.
"""

import json
from pathlib import Path
from typing import Any

OUT = Path(__file__).parent / "schemas"
Schema = dict[str, Any]
NUMBER: Schema = {"type": "number"}
POSITIVE: Schema = {"type": "number", "exclusiveMinimum": 0}
NOT_NEGATIVE: Schema = {"type": "number", "minimum": 0}
TEXT: Schema = {"type": "string", "minLength": 1}
VECTOR: Schema = {"type": "array", "items": NUMBER, "minItems": 3, "maxItems": 3}
NOT_ZERO: Schema = {"type": "number", "not": {"const": 0}}
SCALE: Schema = {
    "type": "object",
    "properties": {f"{quantity}{part}": NOT_ZERO for quantity in ("nominal_stress", "true_stress") for part in ("", "_1", "_2")}
    | {"shear_stress": NOT_ZERO},
    "additionalProperties": POSITIVE,
}
BOX: Schema = {"type": "array", "items": VECTOR, "minItems": 2, "maxItems": 2, "description": "lower and upper corner [m]"}
ROWS: Schema = {
    "type": "array",
    "items": {"type": "integer", "minimum": 0},
    "minItems": 2,
    "maxItems": 2,
    "description": "half-open range of data rows",
}


def record(required: Schema, optional: Schema | None = None, **more: Any) -> Schema:
    """Return the schema of a mapping that takes no other keys."""
    return {"type": "object", "properties": required | (optional or {}), "required": list(required), "additionalProperties": False, **more}


def one_of(values: Any) -> Schema:
    """Return the schema of a choice."""
    return {"enum": list(values)}


def some(entry: Schema) -> Schema:
    """Return the schema of a list that is not empty."""
    return {"type": "array", "items": entry, "minItems": 1}


def effects_of(names: Any) -> Schema:
    """Return the schema of effects that a model has already: flat names with their figures."""
    from neuido.physics.effects import LIBRARY

    entries = {entry.name: entry for entry in LIBRARY}
    pattern = "|".join(sorted(entries[name].name for name in names))
    value: Schema = {"anyOf": [NUMBER, {"type": "object"}, {"type": "array"}]}
    return {"type": ["object", "null"], "patternProperties": {f"^({pattern})(\\.[A-Za-z0-9_]+)?$": value}, "additionalProperties": False}


POISSON: Schema = {"type": "number", "exclusiveMinimum": -1, "exclusiveMaximum": 0.5}
ELASTICITY = {
    "oneOf": [
        record(
            {
                "law": one_of(["fixed_corotated", "sigma", "neo_hookean"]),
                "young": POSITIVE,
                "poisson": {"type": "number", "minimum": -1, "maximum": 0.5},
            }
        )
    ]
}
PLASTICITY = {
    "oneOf": [
        record({"law": one_of(["identity"])}),
        record({"law": one_of(["von_mises"]), "yield_stress": POSITIVE}),
        record({"law": one_of(["drucker_prager"]), "friction_angle": {"type": "number", "minimum": 0, "maximum": 90}}),
    ]
}
SCENE_ELASTICITY = {
    "oneOf": [
        *ELASTICITY["oneOf"],
        record({"law": one_of(["mooney_rivlin"]), "c10": POSITIVE, "c01": NOT_NEGATIVE, "bulk": POSITIVE}),
        record({"law": one_of(["gent"]), "shear": POSITIVE, "limit": POSITIVE, "bulk": POSITIVE}),
        record(
            {
                "law": one_of(["hyperfoam"]),
                "shear": POSITIVE,
                "exponent": POSITIVE,
                "poisson": {"type": "number", "minimum": -1, "maximum": 0.5},
            }
        ),
        record({"law": one_of(["fluid"]), "bulk": POSITIVE}),
    ]
}
SCENE_PLASTICITY = {
    "oneOf": [
        *PLASTICITY["oneOf"],
        record({"law": one_of(["volumetric_reset"])}),
        record({"law": one_of(["snow"]), "compression": {**POSITIVE, "exclusiveMaximum": 1}, "stretch": POSITIVE}),
    ]
}
CONTACT = one_of(["sticky", "slip", "separate"])
PLANE = record({"type": one_of(["plane"]), "point": VECTOR, "normal": VECTOR, "contact": CONTACT}, {"friction": NOT_NEGATIVE})
COLLIDERS = {"type": ["array", "null"], "items": PLANE}
QUATERNION: Schema = {"type": "array", "items": NUMBER, "minItems": 4, "maxItems": 4, "description": "w, x, y, z"}
PATH = record({"times": some(NUMBER), "positions": some(VECTOR)}, {"rotations": some(QUATERNION), "smooth": {"type": "boolean"}})
SHARED: dict[str, Schema] = {
    "name": {"type": "string"},
    "position": VECTOR,
    "rotation": QUATERNION,
    "contact": CONTACT,
    "friction": NOT_NEGATIVE,
    "velocity": VECTOR,
    "spin": VECTOR,
    "path": PATH,
    "mass": POSITIVE,
    "inertia": {"type": "array", "items": VECTOR, "minItems": 3, "maxItems": 3},
}
LATTICE: Schema = {"type": "array", "items": {"type": "array", "items": NUMBER, "minItems": 2}, "minItems": 2}
OWN: dict[str, dict[str, Schema]] = {
    "half_space": {},
    "sphere": {"radius": POSITIVE},
    "cuboid": {"size": {"type": "array", "items": POSITIVE, "minItems": 3, "maxItems": 3}},
    "capsule": {"radius": POSITIVE, "length": POSITIVE},
    "cylinder": {"radius": POSITIVE, "length": POSITIVE},
    "height_field": {"heights": LATTICE, "size": {"type": "array", "items": POSITIVE, "minItems": 2, "maxItems": 2}},
    "mesh": {"file": TEXT},
}
MESH_OPTIONS: dict[str, Schema] = {"scale": POSITIVE, "up": one_of(["x", "y", "z"])}
SOLIDS = [record({"kind": one_of([kind]), **own}, SHARED | (MESH_OPTIONS if kind == "mesh" else {})) for kind, own in OWN.items()]
KIND_PLANE = record({"kind": one_of(["plane"]), "point": VECTOR, "normal": VECTOR, "contact": CONTACT}, {"friction": NOT_NEGATIVE})
MASSES = {"type": ["array", "null"], "items": record({"box": BOX, "mass": POSITIVE})}
SCENE = record(
    {"domain": BOX, "gravity": VECTOR},
    {
        "colliders": COLLIDERS,
        "clamps": {"type": ["array", "null"], "items": record({"box": BOX})},
        "attached_masses": MASSES,
        "walls": {"oneOf": [{"type": "null"}, record({"contact": CONTACT}, {"friction": NOT_NEGATIVE, "inset": NOT_NEGATIVE})]},
    },
)
SCENE_WITH_SOLIDS = {
    **SCENE,
    "properties": SCENE["properties"] | {"colliders": {"type": ["array", "null"], "items": {"oneOf": [PLANE, KIND_PLANE, *SOLIDS]}}},
}
MEASURED_SCENE = {
    **SCENE,
    "properties": SCENE["properties"] | {"clamps": {"type": ["array", "null"], "items": record({"box": BOX}, {"name": TEXT})}},
}
HELD: Schema = {"type": ["object", "null"], "additionalProperties": record({}, {"motion": TEXT, "force": TEXT, "noise": POSITIVE})}
GRID = record({"grid": {"type": "integer", "minimum": 4}, "dt": POSITIVE})
FREE = {"type": "array", "items": TEXT, "uniqueItems": True}


def schemas() -> dict[str, Schema]:
    """Return the schema of each format by its file name."""
    from neuido.data.bodies.scene_files import EFFECTS
    from neuido.data.measured import material_test, plane_experiment, track
    from neuido.data.measured.columns import ROLES
    from neuido.discrepancy.report import diagnosis_format
    from neuido.physics.effects import LIBRARY

    names = [entry.name for entry in LIBRARY if not entry.only]
    role = one_of(ROLES)
    material = {"elasticity": ELASTICITY}
    extra = {"plasticity": PLASTICITY, "free": FREE}
    law = record({"file": TEXT}, {"stiffness": POSITIVE})
    fluid = record({"law": one_of(["newtonian"]), "viscosity": POSITIVE})
    own = record({"density": POSITIVE, **material}, {**extra, "effects": effects_of(names)})
    neural = record({"density": POSITIVE, "law": law}, {**material, **extra, "effects": effects_of(names)})
    columns = [
        {keys: TEXT for keys in choice}
        for path, stress in material_test.MODES.values()
        for choice in [[*p, *s] for p in _choices(path, material_test.STRAINS) for s in _choices(stress, material_test.STRESSES)]
    ]
    columns = [c for i, c in enumerate(columns) if c not in columns[:i]]
    formats = {
        "neuido-experiment-1": record(
            {
                "format": one_of(["neuido-experiment/1"]),
                "name": TEXT,
                "scene": MEASURED_SCENE,
                "model": {"anyOf": [own, neural]},
                "discretisation": GRID,
                "recordings": some(
                    record(
                        {"name": TEXT, "role": role, "frame_interval": POSITIVE},
                        {"noise": NOT_NEGATIVE, "clamps": HELD, "gravity": VECTOR, "attached_masses": MASSES, "colliders": COLLIDERS},
                    )
                ),
            }
        ),
        "neuido-material-test-1": record(
            {
                "format": one_of(["neuido-material-test/1"]),
                "name": TEXT,
                "model": {
                    "oneOf": [
                        record(
                            {"density": POSITIVE, **material},
                            {**extra, "incompressible": {"type": "boolean"}, "effects": effects_of(material_test.EFFECTS)},
                        ),
                        record({"density": POSITIVE, "flow": fluid}, {"free": FREE, "effects": effects_of(material_test.FLUID)}),
                    ]
                },
                "tests": some(
                    record(
                        {
                            "name": TEXT,
                            "file": TEXT,
                            "mode": one_of(material_test.MODES),
                            "columns": {"anyOf": [record(c, {"time": TEXT}) for c in columns]},
                            "role": role,
                        },
                        {
                            "scale": SCALE,
                            "rows": ROWS,
                            "direction": VECTOR,
                            "control": one_of(material_test.CONTROLS),
                            "periodic": {"type": "boolean"},
                            "noise": POSITIVE,
                        },
                    )
                ),
            }
        ),
        "neuido-plane-1": record(
            {
                "format": one_of(["neuido-plane/1"]),
                "name": TEXT,
                "model": record(
                    {"elasticity": record({"law": one_of(plane_experiment.LAWS), "young": POSITIVE, "poisson": POISSON})},
                    {"free": FREE, "effects": effects_of(plane_experiment.EFFECTS)},
                ),
                "specimen": record(
                    {"nodes": TEXT, "elements": TEXT, "thickness": POSITIVE, "condition": one_of(plane_experiment.CONDITIONS)}
                ),
                "recordings": some(
                    record(
                        {"name": TEXT, "role": role, "displacements": some(TEXT)},
                        {
                            "forces": {"anyOf": [TEXT, {"type": "null"}]},
                            "noise": {"oneOf": [{"type": "null"}, record({}, {"displacement": POSITIVE, "force": POSITIVE})]},
                            "continues": {"anyOf": [TEXT, {"type": "null"}]},
                        },
                    )
                ),
            },
            {"boundary": {"type": ["object", "null"], "additionalProperties": one_of(plane_experiment.MOTIONS)}},
        ),
        "neuido-track-1": record(
            {
                "format": one_of(["neuido-track/1"]),
                "name": TEXT,
                "model": record(
                    {"gravity": VECTOR},
                    {
                        "effects": effects_of(track.EFFECTS),
                        "free": FREE,
                        "fluid_density": NOT_NEGATIVE,
                        "constraint": {"oneOf": [{"type": "null"}, *_constraints(track.CONSTRAINTS)]},
                    },
                ),
                "bodies": {
                    "type": "object",
                    "minProperties": 1,
                    "additionalProperties": {
                        "oneOf": [{"type": "null"}, record({}, dict.fromkeys(track.FIGURES, POSITIVE) | {"shape": one_of(track.SHAPES)})]
                    },
                },
                "recordings": some(
                    record(
                        {
                            "name": TEXT,
                            "body": TEXT,
                            "file": TEXT,
                            "columns": {
                                "oneOf": [
                                    record({"t": TEXT}, dict.fromkeys(track.AXES, TEXT), minProperties=2),
                                    record({"t": TEXT, track.ANGLE: TEXT}),
                                ]
                            },
                            "role": role,
                        },
                        {
                            "rows": ROWS,
                            "scale": record({}, dict.fromkeys((*track.AXES, track.ANGLE), NOT_ZERO) | {"t": POSITIVE}),
                            "spin": VECTOR,
                            "attitude": VECTOR,
                            "noise": POSITIVE,
                        },
                    )
                ),
            },
            {"nuisances": {"oneOf": [{"type": "null"}, record({}, dict.fromkeys(track.NUISANCES, NOT_NEGATIVE))]}},
        ),
        "neuido-scene-1": _scene(
            record({"density": POSITIVE, "elasticity": SCENE_ELASTICITY}, {"plasticity": SCENE_PLASTICITY}),
            {"effects": {"type": ["object", "null"], "properties": dict.fromkeys(EFFECTS, NOT_NEGATIVE), "additionalProperties": False}},
        ),
        "neuido-diagnosis-1": _older_diagnosis(names),
        "neuido-diagnosis-2": diagnosis_format.schema(),
    }
    dialect = "https://json-schema.org/draft/2020-12/schema"
    return {f"{name}.schema.json": {"$schema": dialect, "title": name, **schema} for name, schema in formats.items()}


def _scene(model: Schema, effects: Schema) -> Schema:
    """Return the schema of a scene file: of one body with its model and effects, or of several bodies and the contact between them."""
    shape = {"type": "object", "properties": {"shape": one_of(["cube", "box", "ball", "cylinder", "mesh"])}, "required": ["shape"]}
    body = {"anyOf": [record({"particles": TEXT}), shape]}
    pair = {"type": "array", "prefixItems": [TEXT, TEXT, NOT_NEGATIVE], "minItems": 3, "maxItems": 3}
    friction = {"anyOf": [NOT_NEGATIVE, {"type": "array", "items": pair}]}
    common = {"format": one_of(["neuido-scene/1"]), "name": TEXT, "scene": SCENE_WITH_SOLIDS, "discretisation": GRID}
    common["steps"] = {"type": "integer", "minimum": 1}
    more = {"source": {"type": "string"}, "on_inversion": one_of(["report", "error"]), "on_leave": one_of(["error", "clamp", "delete"])}
    contact = record({"kind": one_of(["sticky", "separate"])}, {"friction": friction})
    several = record(common | {"bodies": some(record({"name": TEXT, "model": model, "body": body}))}, more | {"contact": contact})
    alone = {**model, "properties": model["properties"] | effects}
    return {"anyOf": [record(common | {"model": alone, "body": body}, more), several]}


def _constraints(types: Any) -> list[Schema]:
    """Return the schema of each type of constraint, from the figures that it needs and those that it may have."""
    out = []
    for name, (needed, others) in types.items():
        figures = {key: NUMBER if key == "floor" else NOT_NEGATIVE for key in (*needed, *others)}
        figures |= {key: POSITIVE for key in ("length", "restitution") if key in figures}
        figures |= {"stiffness": POSITIVE} if name == "spring" else {}
        figures |= {"restitution": POSITIVE | {"maximum": 1}} if "restitution" in figures else {}
        more = {key: figures[key] for key in others} | ({"normal": VECTOR} if name == "plane" else {})
        out.append(record({"type": one_of([name])} | {key: figures[key] for key in needed}, more))
    return out


def _choices(keys: tuple[str, ...], others: dict[str, str]) -> list[list[str]]:
    """Return the ways to name quantities: all by their own names, or all by the others."""
    renamed = [others.get(key, key) for key in keys]
    return [list(keys)] if renamed == list(keys) else [list(keys), renamed]


def _older_diagnosis(names: list[str]) -> Schema:
    figure: Schema = {"anyOf": [NUMBER, {"type": "null"}, {"type": "array"}]}
    quantity: Schema = {
        "type": "object",
        "properties": {"value": figure, "unit": TEXT, "interval90": {"type": "array"}},
        "required": ["value", "unit", "interval90"],
    }
    quantities: Schema = {"type": "object", "additionalProperties": quantity}
    effect: Schema = {
        "type": "object",
        "properties": {
            "name": one_of(names),
            "class": some(one_of(names)),
            "parameters": quantities,
            "p_value": {"type": "number", "minimum": 0, "maximum": 1},
            "where": {"type": "string"},
        },
        "required": ["name", "class", "parameters", "p_value", "where"],
    }
    maybe: Schema = {"type": ["number", "null"]}
    texts: Schema = {"type": "array", "items": {"type": "string"}}
    scores: Schema = {key: maybe for key in ("fit", "held_out", "validation", "test")}
    errors: Schema = {"type": "object", "properties": scores | {"by_recording": {"type": "object"}}, "required": ["fit", "by_recording"]}
    measured: Schema = {"type": "object", "properties": {"value": figure, "unit": {"type": "string"}}, "required": ["value", "unit"]}
    lead: Schema = {
        "type": "object",
        "properties": {"name": one_of(names), "error_ratio": NUMBER, "parameters": {"type": "object", "additionalProperties": measured}},
        "required": ["name", "error_ratio", "parameters"],
    }
    hidden: Schema = {
        "type": "object",
        "properties": {"name": one_of(names), "parameter": TEXT, "unit": {"type": "string"}, "up_to": maybe},
        "required": ["name", "parameter", "unit", "up_to"],
    }
    part: Schema = {
        "type": "object",
        "properties": {
            "answer": one_of(["effect", "class", "none", "unknown", "insufficient", "unfinished"]),
            "effects": {"type": "array", "items": effect},
            "declared": quantities,
            "after": quantities,
            "error": {
                "type": "object",
                "properties": {
                    "measure": TEXT,
                    "unit": TEXT,
                    "left_over_floor": maybe,
                    "left_over_noise": maybe,
                    "noise_from": {"type": "object", "additionalProperties": one_of(["stated", "estimated", "assumed"])},
                    "before": errors,
                    "after": errors,
                },
                "required": ["measure", "unit", "noise_floor", "discretisation_floor", "before", "after"],
            },
            "rejected": {"type": "array", "items": {"type": "object", "required": ["name", "reason"]}},
            "why": texts,
            "would_help": texts,
            "leads": {"type": "array", "items": lead},
            "untried": {"type": "array", "items": one_of(names)},
            "not_excluded": {"type": "array", "items": hidden},
            "left_out": texts,
            "settings_not_run": {"type": "object", "additionalProperties": texts},
        },
        "required": ["answer", "effects", "declared", "after", "error", "rejected"],
    }
    head: Schema = {"format": one_of(["neuido-diagnosis/1"])}
    several: Schema = {"type": "object", "properties": {"bodies": some(part)}, "required": ["bodies"]}
    return {"type": "object", "properties": head, "required": ["format"], "anyOf": [part, several]}


def main() -> None:
    """Write all schemas."""
    OUT.mkdir(exist_ok=True)
    for name, schema in schemas().items():
        (OUT / name).write_text(json.dumps(schema, indent=1, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    main()
