"""Settings of all tests: two cores, a quiet Warp, the data root, and `gpu` tests only where there is a device."""

import gc
import os
from pathlib import Path

import pytest
import torch
import warp as wp

torch.set_num_threads(1)
wp.config.log_level = wp.LOG_WARNING

gc.disable()  # what collection makes stays until the end: to search it for garbage again and again took a tenth of the time


def pytest_configure(config):
    try:
        import cv2
    except ImportError:
        return
    cv2.setNumThreads(1)


def pytest_collection_modifyitems(items):
    if torch.cuda.is_available():
        return
    for item in items:
        if "gpu" in item.keywords:
            item.add_marker(pytest.mark.skip(reason="needs a CUDA device"))


def pytest_collection_finish():
    gc.freeze()  # leaves modules and tests out of every later search
    gc.enable()


@pytest.fixture(scope="session")
def data_root() -> Path:
    """The folder of particles and measured data, of the environment variable NEUIDO_DATA."""
    root = os.environ.get("NEUIDO_DATA")
    if not root:
        pytest.skip("NEUIDO_DATA is not set: it names the folder of particles and measured data")
    path = Path(root)
    if not path.is_dir():
        pytest.skip(f"NEUIDO_DATA names '{root}', which is not a folder")
    return path
