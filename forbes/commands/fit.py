"""The commands `forbes fit`, `validate`, `test` and `predict`: a configuration, run by Lightning's Trainer."""

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
from typing import Any

import torch
from jsonargparse import DefaultHelpFormatter
from lightning import LightningModule, Trainer
from lightning.fabric.plugins import CheckpointIO
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch.callbacks import ProgressBar
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI
from lightning.pytorch.utilities.exceptions import SIGTERMException
from torch import Tensor

import forbes.callbacks  # so that configurations know them by their short names
from forbes.callbacks.divergence import StopAtDivergence
from forbes.commands.lower_rate import MOST, LowerRateError, at_half_the_rate
from forbes.commands.parsers.fit import DESCRIPTION, run_options
from forbes.commands.trainer_arguments import require_usable
from forbes.data import SequenceDataModule
from forbes.errors import ForbesError
from forbes.runs.checkpoint import AtomicCheckpointIO, ResumeWholeEpochs, SaveLast, read_checkpoint
from forbes.runs.config_errors import building, one_sentence, raised_inside, said_by_lightning
from forbes.runs.configuration import (
    add_links,
    add_seed,
    allow_modules,
    changed_defaults,
    data_paths,
    require_classes,
)
from forbes.runs.folder import RunFolder, experiment_name, read_config
from forbes.runs.loggers import ParserOfRuns, open_logger
from forbes.runs.metrics_log import JsonLinesLogger, MarkStart
from forbes.runs.modules import check_weights, weights_of
from forbes.runs.progress import progress
from forbes.runs.provenance import RecordRun, read_provenance
from forbes.runs.stop import StopOnSignal
from forbes.training.divergence import DivergedError

__all__ = ["fit", "predict", "test", "validate"]

sys.modules["forbes.training.callbacks"] = forbes.callbacks  # the configurations of older runs have it

_LIMITS = ("max_epochs", "max_steps", "max_time", "limit_train_batches")

_NOT_OURS = (  # warnings that say nothing true or useful here
    ".*does not have many workers.*",  # a batch is gathered in less time than a worker needs to hand it over
    ".*dataloader is not resumable.*",  # it goes on from the trainer's update
    ".*`IterableDataset` has `__len__` defined.*",  # there are no workers
    ".*You requested to overfit but enabled .* dataloader shuffling.*",  # nor do they shuffle
    ".*smaller than the logging interval.*",  # the interval counts updates, whatever number of them is an epoch
    ".*treespec, LeafSpec.*",  # Lightning 2.6 calls torch 2.13 the old way
    "(?s).*JsonargparseDeprecationWarning",  # and jsonargparse 4.53
    "(?s).*instantiate_classes",
)


def fit(arguments: Sequence[str]) -> int:
    """Train a model and give the exit status."""
    lowered = 0
    while True:
        try:
            return _run("fit", arguments)
        except LowerRateError as error:
            if lowered == MOST:
                raise
            lowered, arguments = lowered + 1, at_half_the_rate(error)
            signal.signal(signal.SIGINT, signal.default_int_handler)  # of no training, until the next has begun


def validate(arguments: Sequence[str]) -> int:
    """Run the validation loop and give the exit status."""
    return _run("validate", arguments)


def test(arguments: Sequence[str]) -> int:
    """Run the test loop and give the exit status."""
    return _run("test", arguments)


def predict(arguments: Sequence[str]) -> int:
    """Run the prediction loop and give the exit status."""
    return _run("predict", arguments)


def _run(command: str, arguments: Sequence[str]) -> int:
    """Run a command and turn what the libraries say about a wrong configuration into one sentence."""
    for name in ("lightning.fabric", "lightning.pytorch"):
        logging.getLogger(name).setLevel(logging.WARNING)
    for name in ("profilers.profiler", "callbacks.model_summary"):  # what they say has been asked for
        logging.getLogger(f"lightning.pytorch.{name}").setLevel(logging.INFO)
    allow_modules()
    with ExitStack() as stack, warnings.catch_warnings():
        for message in _NOT_OURS:
            warnings.filterwarnings("ignore", message)
        try:
            return _Experiment(command, arguments, stack).execute()
        except argparse.ArgumentError as error:
            raise ForbesError(one_sentence(str(error), arguments)) from error
        except (MisconfigurationException, ImportError, RuntimeError, TypeError, ValueError) as error:
            if inner := raised_inside(error):
                raise inner from None
            if said := said_by_lightning(error):
                raise ForbesError(said) from error
            raise


class _Help(argparse.RawDescriptionHelpFormatter, DefaultHelpFormatter):
    """Keeps the line breaks of the run folder's options."""


class _Experiment(LightningCLI):
    """A command with its model, data and trainer.

    Args:
        command: fit, validate, test or predict.
        arguments: its options.
        stack: closed when the command ends; it holds the lock of the run folder.
    """

    def __init__(self, command: str, arguments: Sequence[str], stack: ExitStack) -> None:
        self.command, self.arguments, self.stack = command, arguments, stack
        options = run_options()
        self.options, rest = options.parse_known_args(arguments if command == "fit" else [])
        for option in ("resume", "run_dir"):
            if (folder := getattr(self.options, option)) and folder.endswith(".ckpt"):
                raise ForbesError(f"--{option} {folder}: is the name of a checkpoint, expected that of a run folder")
        self.resumed = RunFolder.trained(self.options.resume) if self.options.resume else None
        if command != "fit":
            rest = list(arguments)
        elif self.resumed:
            older = changed_defaults(read_config(self.resumed.config))
            flags = [part for key, value in older.items() for part in (f"--{key}", str(value))]
            rest = ["--config", str(self.resumed.config), *flags, *rest]
        super().__init__(
            model_class=LightningModule,
            datamodule_class=SequenceDataModule,
            save_config_callback=RecordRun,
            trainer_defaults={"devices": 1, "enable_model_summary": False},
            parser_kwargs={
                "prog": f"forbes {self.command}",
                "usage": f"forbes {self.command} --config FILE [--OPTION VALUE ...]",
                "formatter_class": _Help,
                "description": DESCRIPTION[self.command],
                "epilog": options.format_help() if self.command == "fit" else None,
                "exit_on_error": False,
                "allow_abbrev": False,
            },
            subclass_mode_model=True,
            subclass_mode_data=True,
            args=rest,
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
        """Parse; Lightning's own would warn that the process has arguments, too. A run knows its data from anywhere."""
        with building(self._where()):
            self.config = parser.parse_args(args)
        for section in ("model", "data", "trainer"):
            require_classes(self.config[section], section)
        data = self.config["data"]
        for key, path in data_paths(data).items():
            data[key] = str(Path(path).absolute())

    def instantiate_classes(self) -> None:
        """Build what the configuration names."""
        with building(self._where()):
            super().instantiate_classes()

    def _where(self) -> str:
        """Name the configuration."""
        files = [value for flag, value in itertools.pairwise(self.arguments) if flag in ("--config", "-c", "--resume")]
        return " and ".join(files) or "the configuration"

    def instantiate_trainer(self, **kwargs: Any) -> Trainer:
        """Build the trainer; for `fit` with a run folder and all that fills it."""
        config = self.config_init["trainer"]
        require_usable(config, self.model, self.datamodule)
        callbacks, plugins = _as_list(config["callbacks"]), _as_list(config["plugins"])
        if config["enable_progress_bar"] is not False and not any(isinstance(c, ProgressBar) for c in callbacks):
            callbacks.append(progress())
        if not any(isinstance(plugin, CheckpointIO) for plugin in plugins):
            plugins.append(AtomicCheckpointIO())
        self.stop: StopOnSignal | None = None
        if self.command != "fit" or config["fast_dev_run"]:
            self.save_config_callback = None
            given = {"logger": False, "enable_checkpointing": False}
        else:
            given = self._run_arguments(config, callbacks)
        return super().instantiate_trainer(**given, callbacks=callbacks, plugins=plugins, **kwargs)

    def _run_arguments(self, config: Any, callbacks: list[Any]) -> dict[str, Any]:
        """Open the run folder, add the callbacks that fill it, and give the trainer's arguments that name it."""
        run = self._open_run()
        print(f"run folder: {run}", flush=True)
        self.stop = StopOnSignal(run)
        self.save_config_kwargs = {"run": run, "stop": self.stop, "arguments": [self.command, *self.arguments]}
        callbacks += [ResumeWholeEpochs(), MarkStart(), self.stop, StopAtDivergence(run)]
        if config["enable_checkpointing"] is not False:
            callbacks.append(SaveLast(run))
        loggers = config["logger"]
        if loggers is not False:
            named = _as_list(None if loggers is True else loggers)
            loggers = [JsonLinesLogger(run.metrics), *(open_logger(logger, run.path) for logger in named)]
        return {"logger": loggers, "default_root_dir": config["default_root_dir"] or run.path}

    def _open_run(self) -> RunFolder:
        """Make the run folder, or take the one that was named, and keep other processes out."""
        options = self.options
        if self.resumed:
            run = self.resumed
        elif options.run_dir:
            run = RunFolder(options.run_dir)
        else:
            experiment = options.experiment or experiment_name([str(path) for path in self.config["config"] or []])
            run = RunFolder.new(experiment, time.strftime("%Y%m%d-%H%M%S"), self.config["seed_everything"])
        self.stack.enter_context(run.locked())
        if not self.resumed and run.checkpoint.exists():
            raise ForbesError(f"{run}: holds a trained run. Name another, or go on with it: forbes fit --resume {run}")
        if run.provenance.is_file():
            read_provenance(run.provenance)  # a broken one is said before the training begins
        return run

    def execute(self) -> int:
        """Run the command and give its exit status."""
        checkpoint = self.resumed.checkpoint if self.resumed else self.config.get("ckpt_path")
        updates = 0
        if checkpoint:
            content = read_checkpoint(Path(checkpoint))
            check_weights(self.model, weights_of(content, str(checkpoint)), str(checkpoint))
            updates = content["global_step"]
        how = {"datamodule": self.datamodule, "ckpt_path": checkpoint, "weights_only": True}
        if self.command in ("validate", "test"):
            how["verbose"] = False  # Lightning's table would leave out what is in brackets
        try:
            found = getattr(self.trainer, self.command)(self.model, **how)
        except DivergedError as error:
            if self.options.on_divergence == "stop" or self.stop is None or self.stop.received is not None:
                raise
            raise LowerRateError(error, self.stop.run) from error
        except SIGTERMException:
            if self.stop is None:
                return 128 + signal.SIGTERM
            print(f"stopped at update {self.trainer.global_step}, go on with: forbes fit --resume {self.stop.run}")
            return self.stop.exit_status
        if self.command == "predict":
            _print_predictions(found)
        elif self.command != "fit":
            _print_metrics(found)
        elif self.trainer.global_step == updates:
            print(f"nothing was trained: {self._limits()} ends it at update {updates}. Give a higher limit to train on")
        return 0

    def _limits(self) -> str:
        """Name what may end the training before it begins, as the configuration says it."""
        trainer = self.config["trainer"]
        names = [name for name in _LIMITS if trainer[name] not in (None, -1)]
        return ", ".join(f"{name} {trainer[name]}" for name in names)


def _print_metrics(found: Sequence[Mapping[str, float]]) -> None:
    """Print one metric a line."""
    for name, value in itertools.chain.from_iterable(metrics.items() for metrics in found):
        print(f"{name}  {value}")


def _print_predictions(found: Sequence[Tensor]) -> None:
    """Print one sequence a line, its numbers `(B,)` or `(B, T)` apart by tabs."""
    for values in torch.cat(list(found)).tolist():
        print(*(values if isinstance(values, list) else [values]), sep="\t")


def _as_list(value: Any) -> list[Any]:
    """Return what a configuration holds as one thing, several, or none."""
    return [] if value is None else list(value) if isinstance(value, list) else [value]
