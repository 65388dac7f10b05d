"""The commands `forbes fit`, `validate`, `test` and `predict`: run a configuration with Lightning's Trainer."""

import argparse
import itertools
import logging
import signal
import sys
import time
import warnings
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from jsonargparse import DefaultHelpFormatter
from lightning import LightningModule, Trainer
from lightning.fabric.plugins import CheckpointIO
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch.callbacks import Callback, ProgressBar
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI
from lightning.pytorch.loggers import Logger
from lightning.pytorch.utilities.exceptions import SIGTERMException
from torch import Tensor

import forbes.callbacks  # registers their short names for configurations
from forbes.callbacks.collapse import WarnOfCollapse
from forbes.callbacks.divergence import StopAtDivergence
from forbes.callbacks.picture import FileCallback
from forbes.commands.fit_options import FitOptions
from forbes.commands.lower_rate import MOST, LowerRateError, at_half_the_rate
from forbes.commands.next_steps import next_steps
from forbes.commands.parsers.fit import DESCRIPTION, run_options
from forbes.commands.trainer_arguments import require_processes, require_usable
from forbes.data import SequenceDataModule
from forbes.errors import ForbesError
from forbes.runs.checkpoint import read_checkpoint
from forbes.runs.config_errors import building, one_sentence, raised_inside, said_by_lightning
from forbes.runs.configs import with_config_paths
from forbes.runs.configuration import (
    add_links,
    add_seed,
    allow_modules,
    data_paths,
    require_classes,
)
from forbes.runs.end_together import EndTogether
from forbes.runs.folder import RunFolder, experiment_name
from forbes.runs.launched import chosen_by_first, is_first, launched_devices, lost_process
from forbes.runs.loggers import ParserOfRuns, open_logger, shows
from forbes.runs.metrics_log import JsonLinesLogger, MarkStart
from forbes.runs.progress import progress
from forbes.runs.provenance import read_provenance
from forbes.runs.recorded import RecordRun
from forbes.runs.saving import AtomicCheckpointIO, ResumeWholeEpochs, SaveLast
from forbes.runs.stop import StopOnSignal
from forbes.runs.worlds import check_weights, weights_of
from forbes.training.divergence import DivergedError

__all__ = ["fit", "predict", "test", "validate"]

sys.modules["forbes.training.callbacks"] = forbes.callbacks  # the configurations of older runs have it

_LIMITS = ("max_epochs", "max_steps", "max_time", "limit_train_batches")

_NOT_OURS = (  # warnings that do not apply here
    ".*does not have many workers.*",  # gathering a batch takes less time than the transfer from a worker
    ".*dataloader is not resumable.*",  # it resumes from the trainer's update
    ".*`IterableDataset` has `__len__` defined.*",  # there are no workers
    ".*You requested to overfit but enabled .* dataloader shuffling.*",  # the batches are not shuffled
    ".*smaller than the logging interval.*",  # the interval counts updates, not epochs
    ".*recommended to use `self.log.*sync_dist=True.*",  # the values are those of all processes
    ".*treespec, LeafSpec.*",  # Lightning 2.6 calls torch 2.13 the old way
    "(?s).*JsonargparseDeprecationWarning",  # and jsonargparse 4.53
    "(?s).*instantiate_classes",
)


def fit(arguments: Sequence[str]) -> int:
    """Train a model and return the exit status."""
    lowered = 0
    while True:
        try:
            return _run("fit", arguments)
        except LowerRateError as error:
            if lowered == MOST:
                raise
            lowered, arguments = lowered + 1, at_half_the_rate(error)
            signal.signal(signal.SIGINT, signal.default_int_handler)  # until the next training installs its own


def validate(arguments: Sequence[str]) -> int:
    """Run the validation loop and return the exit status."""
    return _run("validate", arguments)


def test(arguments: Sequence[str]) -> int:
    """Run the test loop and return the exit status."""
    return _run("test", arguments)


def predict(arguments: Sequence[str]) -> int:
    """Run the prediction loop and return the exit status."""
    return _run("predict", arguments)


def _run(command: str, arguments: Sequence[str]) -> int:
    """Run a command; turn the libraries' errors about a wrong configuration into one sentence."""
    for name in ("lightning.fabric", "lightning.pytorch"):
        logging.getLogger(name).setLevel(logging.WARNING)
    for name in ("profilers.profiler", "callbacks.model_summary"):  # the user has requested their output
        logging.getLogger(f"lightning.pytorch.{name}").setLevel(logging.INFO)
    allow_modules()
    with_paths = with_config_paths(arguments)
    with ExitStack() as stack, warnings.catch_warnings():
        for message in _NOT_OURS:
            warnings.filterwarnings("ignore", message)
        try:
            return _Experiment(command, arguments, with_paths, stack).execute()
        except argparse.ArgumentError as error:
            raise ForbesError(one_sentence(str(error), with_paths)) from error
        except (MisconfigurationException, ImportError, RuntimeError, TypeError, ValueError) as error:
            if inner := raised_inside(error):
                raise inner from None
            if said := said_by_lightning(error):
                raise ForbesError(said) from error
            raise


class _Help(argparse.RawDescriptionHelpFormatter, DefaultHelpFormatter):
    """Help formatter that keeps the line breaks of the run folder's options."""


class _Experiment(LightningCLI):
    """A command with its model, data and trainer.

    Args:
        command: fit, validate, test or predict.
        arguments: options of the command, as they are recorded.
        with_paths: the same, with `--config PATH` for each configuration.
        stack: exit stack that holds the lock of the run folder; closed when the command ends.
    """

    def __init__(self, command: str, arguments: Sequence[str], with_paths: Sequence[str], stack: ExitStack) -> None:
        self.command, self.arguments, self.with_paths, self.stack = command, arguments, with_paths, stack
        self.stop: StopOnSignal | None = None
        self.together: EndTogether | None = None
        self.options, configuration = FitOptions(), list(with_paths)
        if command == "fit":
            self.options, configuration = FitOptions.parse(with_paths)
        super().__init__(
            model_class=LightningModule,
            datamodule_class=SequenceDataModule,
            save_config_callback=RecordRun,
            trainer_defaults={"devices": 1, "enable_model_summary": False},
            parser_kwargs={
                "prog": f"forbes {self.command}",
                "usage": f"forbes {self.command} CONFIG [CONFIG ...] [--OPTION VALUE ...]",
                "formatter_class": _Help,
                "description": DESCRIPTION[self.command],
                "epilog": run_options().format_help() if self.command == "fit" else None,
                "exit_on_error": False,
                "allow_abbrev": False,
            },
            subclass_mode_model=True,
            subclass_mode_data=True,
            args=configuration,
            run=False,
            auto_configure_optimizers=False,
            load_from_checkpoint_support=False,
            parser_class=ParserOfRuns,
        )

    def add_default_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """Add the seed."""
        add_seed(parser)

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """Add the links, and the checkpoint for the commands that need one."""
        add_links(parser)
        if self.command != "fit":
            parser.add_argument(
                "--ckpt_path", type=str, required=True, help="a trained model: runs/.../checkpoints/last.ckpt"
            )

    def parse_arguments(self, parser: LightningArgumentParser, args: Any) -> None:
        """Parse the arguments, without Lightning's warning about `sys.argv`, and make paths of data absolute."""
        with building(self._where()):
            self.config = parser.parse_args(args)
        for section in ("model", "data", "trainer"):
            require_classes(self.config[section], section)
        if launched := launched_devices():
            self.config["trainer"]["devices"], self.config["trainer"]["num_nodes"] = launched
        data = self.config["data"]
        for key, path in data_paths(data).items():
            data[key] = str(Path(path).absolute())

    def instantiate_classes(self) -> None:
        """Instantiate the classes of the configuration."""
        with building(self._where()):
            super().instantiate_classes()

    def _where(self) -> str:
        """Return the configuration files, for error messages."""
        files = [value for flag, value in itertools.pairwise(self.with_paths) if flag in ("--config", "--resume")]
        return " and ".join(files) or "the configuration"

    def instantiate_trainer(self, **kwargs: Any) -> Trainer:
        """Build the trainer. For `fit`, open the run folder and add the callbacks and loggers that write to it."""
        config = self.config_init["trainer"]
        require_usable(config, self.command, self.model, self.datamodule)
        require_processes(config, self.command, self.options.on_divergence)
        callbacks, plugins = _as_list(config["callbacks"]), _as_list(config["plugins"])
        if config["enable_progress_bar"] is not False and not any(isinstance(c, ProgressBar) for c in callbacks):
            callbacks.append(progress())
        if not any(isinstance(plugin, CheckpointIO) for plugin in plugins):
            plugins.append(AtomicCheckpointIO())
        if self.command == "fit" and not config["fast_dev_run"]:
            given = self._run_arguments(config, callbacks)
        else:  # writes nothing; the episodes that an agent plays in a dry run do not outlive it
            self.save_config_callback = None
            given = {"logger": False, "enable_checkpointing": False}
            given["default_root_dir"] = self.stack.enter_context(TemporaryDirectory(prefix="forbes-"))
        trainer = super().instantiate_trainer(**given, callbacks=callbacks, plugins=plugins, **kwargs)
        if config["limit_val_batches"] == 0:
            trainer.limit_val_batches = 0  # Lightning sets 1 in a dry run
        return trainer

    def _run_arguments(self, config: Any, callbacks: list[Any]) -> dict[str, Any]:
        """Open the run folder, add the callbacks that write to it, and return the trainer's arguments that name it."""
        run = self._open_run()
        if is_first():
            print(f"run folder: {run}", flush=True)
        self.stop, self.together = StopOnSignal(run), EndTogether(run)
        self.save_config_kwargs = {"run": run, "stop": self.stop, "arguments": [self.command, *self.arguments]}
        callbacks += [
            ResumeWholeEpochs(),
            MarkStart(),
            self.stop,
            self.together,
            StopAtDivergence(run),
            WarnOfCollapse(),
        ]
        if config["enable_checkpointing"] is not False:
            callbacks.append(SaveLast(run))
        loggers = config["logger"]
        if loggers is not False:
            named = _as_list(None if loggers is True else loggers)
            opened = [open_logger(logger, run.path) for logger in named if is_first()]
            _tell_hidden_pictures(opened, callbacks, run)
            loggers = [JsonLinesLogger(run.metrics), *opened]
        return {"logger": loggers, "default_root_dir": config["default_root_dir"] or run.path}

    def _open_run(self) -> RunFolder:
        """Create the run folder, or use the one that was named; the first process of a training locks it."""
        options = self.options
        if options.resumed:
            run = options.resumed
        elif options.run_dir:
            run = RunFolder(options.run_dir)
        else:
            experiment = options.experiment or experiment_name([str(path) for path in self.config["config"] or []])
            started, seed = time.strftime("%Y%m%d-%H%M%S"), self.config["seed_everything"]
            run = RunFolder(chosen_by_first(lambda: str(RunFolder.new(experiment, started, seed))))
        if not is_first():
            return run
        self.stack.enter_context(run.locked())
        if not options.resumed and run.checkpoint.exists():
            raise ForbesError(f"{run}: holds a trained run. Name another, or resume it: forbes fit --resume {run}")
        if run.provenance.is_file():
            read_provenance(run.provenance)  # reports a damaged file before the training begins
        return run

    def execute(self) -> int:
        """Run the command and return its exit status."""
        checkpoint = self.options.resumed.checkpoint if self.options.resumed else self.config.get("ckpt_path")
        updates = 0
        if checkpoint:
            content = read_checkpoint(Path(checkpoint))
            check_weights(self.model, weights_of(content, str(checkpoint)), str(checkpoint))
            updates = content["global_step"]
            if self.command == "fit" and "optimizer_states" not in content:
                raise ForbesError(f"{checkpoint}: has no optimizer, it was exported. Train a new run: --config FILE")
        how = {"datamodule": self.datamodule, "ckpt_path": checkpoint, "weights_only": True}
        if self.command in ("validate", "test"):
            how["verbose"] = False  # Lightning's table would drop text in brackets
        try:
            found = getattr(self.trainer, self.command)(self.model, **how)
        except RuntimeError as error:
            if self.together is None or not lost_process(error):
                raise
            raise ForbesError(self.together.sentence()) from error
        except DivergedError as error:
            if not is_first():  # it says so
                return 0
            if self.options.on_divergence == "stop" or self.stop is None or self.stop.received is not None:
                raise
            raise LowerRateError(error, self.stop.run) from error
        except SIGTERMException:
            if not is_first():
                return 0
            if self.stop is None:
                return 128 + signal.SIGTERM
            print(f"stopped at update {self.trainer.global_step}, resume with: forbes fit --resume {self.stop.run}")
            return self.stop.exit_status
        if not is_first():
            return 0
        if self.command == "predict":
            _print_predictions(found)
        elif self.command != "fit":
            _print_metrics(found)
        elif self.trainer.global_step == updates:
            print(f"nothing was trained: {self._limits()} ends at update {updates}. Set a higher limit to continue")
        elif self.stop is not None:
            print(next_steps(self.stop.run, self.model))
        return 0

    def _limits(self) -> str:
        """Return the limits in the configuration that may end the training before it begins."""
        trainer = self.config["trainer"]
        names = [name for name in _LIMITS if trainer[name] not in (None, -1)]
        return ", ".join(f"{name} {trainer[name]}" for name in names)


def _tell_hidden_pictures(loggers: Sequence[Logger], callbacks: Sequence[Callback], run: RunFolder) -> None:
    """Print which pictures of the callbacks a logger does not show."""
    names = [callback.filename for callback in callbacks if isinstance(callback, FileCallback)]
    for logger in loggers:
        if hidden := [name for name in names if not shows(logger, name)]:
            print(f"{type(logger).__name__} does not show {', '.join(hidden)}; see {run.figures}", flush=True)


def _print_metrics(found: Sequence[Mapping[str, float]]) -> None:
    """Print one metric per line."""
    for name, value in itertools.chain.from_iterable(metrics.items() for metrics in found):
        print(f"{name}  {value}")


def _print_predictions(found: Sequence[Tensor]) -> None:
    """Print one line per sequence of `(B,)` or `(B, T)`, with tabs between the values."""
    for values in torch.cat(list(found)).tolist():
        print(*(values if isinstance(values, list) else [values]), sep="\t")


def _as_list(value: Any) -> list[Any]:
    """Return a configuration's value, which may be a list, a single item or None, as a new list."""
    if value is None:
        return []
    return list(value) if isinstance(value, list) else [value]
