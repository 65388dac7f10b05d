"""Files that come with the package, among them trained models: `pretrained:NAME` in the place of a run folder."""

from pathlib import Path

from forbes.errors import ForbesError

__all__ = ["PRETRAINED", "bundled", "is_pretrained", "pretrained_names", "run_path", "shipped"]

PRETRAINED = "pretrained:"
"""Prefix of the name of a trained model that comes with the package."""


def shipped(name: str) -> Path:
    """Return the path of a file or folder that is in `forbes/` of a wheel, and next to `forbes/` in a checkout."""
    package = Path(__file__).parent
    in_wheel = package / name
    return in_wheel if in_wheel.exists() else package.parent / name


def bundled(name: str) -> Path:
    """Return the path of a file or folder of `data/` that comes with the package."""
    return shipped(f"data/{name}")


def pretrained_names() -> list[str]:
    """Return the names of the trained models that come with the package."""
    return sorted(config.parent.name for config in bundled("pretrained").glob("*/config.yaml"))


def is_pretrained(run: Path | str) -> bool:
    """Return whether this is the name of a trained model in the package, `pretrained:NAME`."""
    return str(run).startswith(PRETRAINED)


def run_path(run: Path | str) -> Path:
    """Return the path of a run folder, or of a checkpoint in it; `pretrained:NAME` is the folder in the package.

    Raises:
        ForbesError: if there is no trained model of this name.
    """
    if not is_pretrained(run):
        return Path(run)
    name, *inside = str(run).removeprefix(PRETRAINED).split("/")
    if name not in (names := pretrained_names()):
        known = ", ".join(f"{PRETRAINED}{one}" for one in names) or "none in this installation"
        raise ForbesError(f"{run}: no such trained model. There are {known}")
    return bundled("pretrained").joinpath(name, *inside)
