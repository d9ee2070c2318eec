"""What Lightning says at the start of every run and what nobody reads twice."""

import logging
import re
import warnings


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
