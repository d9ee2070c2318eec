"""The page `docs/paper.md` and the files of `configs/paper` say the same."""

import re

import pytest
import yaml

import neuido
from neuido.data.files.yaml_files import read_configuration

ROOT = neuido.configs_root()
PAGE = (ROOT.parent / "docs" / "paper.md").read_text()
FILES = sorted(path.stem for path in (ROOT / "paper").glob("*.yaml"))
OWN_BUSINESS = re.compile(
    r"(^|\.)(class_path|seed|seed_everything|root|out|cache|save_to|preload|num_workers|logger\..*|callbacks|log_every_n_steps|num_sanity_val_steps"
    r"|check_val_every_n_epoch|limit_val_batches|enable_model_summary|use_distributed_sampler)$"
)
"""Options that no experiment depends on: where files lie, how a run is logged, and its seed."""


def options(content, at=()) -> dict:
    """Every option of a configuration by its dotted name."""
    if isinstance(content, dict) and content:
        return {name: value for key, part in content.items() for name, value in options(part, (*at, key)).items()}
    return {".".join(key for key in at if key != "init_args"): content}


def of_file(stem) -> dict:
    return options(read_configuration(ROOT / "paper" / f"{stem}.yaml"))


STATED = [(stem, key, yaml.safe_load(value)) for stem, key, value in re.findall(r"`(\w+): ([\w.]+) = (.+?)`", PAGE)]


def test_each_file_has_statements():
    assert FILES == ["few_shot", "stage1", "stage2", "trajectories", "zero_shot"]
    assert {stem for stem, _, _ in STATED} == set(FILES)


@pytest.mark.parametrize(("stem", "key", "value"), STATED, ids=lambda v: str(v)[:40])
def test_a_statement_of_the_page_holds_in_its_file(stem, key, value):
    found = of_file(stem)
    assert key in found and found[key] == value and type(found[key]) is type(value)


@pytest.mark.parametrize("stem", [stem for stem in FILES if stem != "zero_shot"])
def test_every_option_of_a_file_is_on_the_page(stem):
    stated = {key for name, key, _ in STATED if name == stem}
    assert {key for key in of_file(stem) if not OWN_BUSINESS.search(key)} == stated


def test_zero_shot_differs_from_stage_2_by_its_encoder_alone():
    ours, theirs = of_file("zero_shot"), of_file("stage2")
    changed = {key for key in ours | theirs if ours.get(key) != theirs.get(key) and not OWN_BUSINESS.search(key)}
    assert changed == {"model.init_from"}
