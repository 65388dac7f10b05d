"""Options of `forbes fit` that are not part of the configuration: the run folder, and what to do after a divergence."""

from collections.abc import Sequence
from typing import NamedTuple

from forbes.bundled import is_pretrained
from forbes.commands.parsers.fit import run_options
from forbes.errors import ForbesError
from forbes.runs.configuration import changed_defaults
from forbes.runs.folder import RunFolder, read_config

__all__ = ["FitOptions"]


class FitOptions(NamedTuple):
    """Options of `fit` that are not part of the configuration."""

    experiment: str | None = None
    """Name of the experiment."""
    run_dir: str | None = None
    """Path of the run folder."""
    resumed: RunFolder | None = None
    """Run folder to resume."""
    on_divergence: str = "stop"
    """What to do after a divergence: stop or lower-rate."""

    @classmethod
    def parse(cls, arguments: Sequence[str]) -> tuple["FitOptions", list[str]]:
        """Return the options, and the arguments of the configuration, after those of a resumed run."""
        options, rest = run_options().parse_known_args(arguments)
        for option in ("resume", "run_dir"):
            if getattr(options, option) == "":
                raise ForbesError(f"--{option}: is empty, expected a run folder. Name one, or leave it out")
            if (folder := getattr(options, option)) and folder.endswith(".ckpt"):
                raise ForbesError(f"--{option} {folder}: is a checkpoint, expected a run folder")
            if folder and is_pretrained(folder):
                raise ForbesError(f"--{option} {folder}: comes with the package, expected a folder that can be written")
        if not options.resume:
            return cls(options.experiment, options.run_dir, None, options.on_divergence), rest
        run = RunFolder.trained(options.resume)
        older = changed_defaults(read_config(run.config))
        flags = [part for key, value in older.items() for part in (f"--{key}", str(value))]
        return cls(resumed=run, on_divergence=options.on_divergence), ["--config", str(run.config), *flags, *rest]
