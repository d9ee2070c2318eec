"""Warnings on the terminal: what is odd in measured data, one line each, without what Lightning says at the start of every run."""

import logging
import re
import sys
import warnings
from typing import Any

from neuido.errors import PlausibilityWarning


def quiet_lightning() -> None:
    """Drop lightning's advertisements and the warnings about its own code."""
    logging.getLogger("lightning.fabric.utilities.seed").setLevel(logging.WARNING)  # config.yaml states the seed
    chatter = re.compile(r".*Tip: |TPU available|GPU available: False")
    logging.getLogger("lightning.pytorch.utilities.rank_zero").addFilter(lambda record: not chatter.match(record.getMessage()))
    warnings.filterwarnings("ignore", message=r".*LightningCLI's args parameter is intended")  # sys.argv is passed on as it is
    warnings.filterwarnings("ignore", message=r".*isinstance\(treespec, LeafSpec\).* is deprecated")
    warnings.filterwarnings("ignore", message=r".*tensorboardX.* has been removed")
    warnings.filterwarnings("ignore", message=r".*does not have many workers")  # the data sets are memory maps
    warnings.filterwarnings("ignore", message=r".*but have no `validation_step`")  # adaptation scores before and after each scene
    warnings.filterwarnings("ignore", message=r".*in eval mode at the start of training")  # what is frozen is meant to be


def print_oddities() -> None:
    """Print warnings of odd data as one line of stderr each, all of them; other warnings are printed as before."""
    usual = warnings.showwarning

    def show(message: Warning | str, category: type[Warning], *place: Any) -> None:
        if issubclass(category, PlausibilityWarning):
            print(f"neuido: odd: {message}", file=sys.stderr)
        else:
            usual(message, category, *place)

    warnings.showwarning = show
    warnings.simplefilter("always", PlausibilityWarning)
