"""The version of neuido, and where its files are installed."""

from pathlib import Path

__version__ = "0.1.0"


def configs_root() -> Path:
    """Return the folder of the configurations: beside the package in a checkout, inside it in a wheel."""
    package = Path(__file__).resolve().parent
    checkout = package.parent
    return checkout / "configs" if (checkout / "pyproject.toml").is_file() else package / "configs"
