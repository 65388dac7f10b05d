"""The command `forbes`: list the commands, dispatch to one of them, and print errors as one sentence."""

import argparse
import difflib
import importlib
import itertools
import os
import sys
from collections.abc import Callable, Sequence
from typing import NamedTuple

from forbes import __version__
from forbes.commands.arguments import existing_run
from forbes.commands.parsers.fit import DESCRIPTION, help_page
from forbes.errors import FULL, ForbesError, unwritable

__all__ = ["main"]


class Command(NamedTuple):
    """Summary and example of a command, and the function that runs it as `module:function(arguments)`."""

    summary: str
    example: str
    target: str


_TRAINED = "RUN/config.yaml --ckpt_path RUN/checkpoints/last.ckpt"
COMMANDS = {
    "fit": Command("train a model", "strokes/forbes", "forbes.commands.fit:fit"),
    "validate": Command("run the validation loop of a model", _TRAINED, "forbes.commands.fit:validate"),
    "test": Command("run the test loop of a model", _TRAINED, "forbes.commands.fit:test"),
    "predict": Command("run the prediction loop of a model", _TRAINED, "forbes.commands.fit:predict"),
    "configs": Command(
        "list, show and copy configurations", "copy strokes/forbes mine.yaml", "forbes.commands.configs:main"
    ),
    "runs": Command("list runs and show their curves", "show RUN", "forbes.commands.runs:main"),
    "replay": Command("show where a training diverged", "RUN/failure.pt", "forbes.commands.replay:main"),
    "evaluate": Command("evaluate trained models and compare them", "RUN RUN", "forbes.commands.evaluate:main"),
    "rollout": Command("record an agent as a GIF or MP4", "RUN --video agent.gif", "forbes.commands.rollout:main"),
    "beliefs": Command("compare learned beliefs with exact ones", "RUN RUN", "forbes.commands.beliefs:main"),
    "theorem": Command("check Theorem 1 in closed form", "--steps 30", "forbes.commands.theorem:main"),
    "compare": Command(
        "train several configurations and compare them",
        "strokes/rssm strokes/forbes --seeds 3",
        "forbes.commands.compare:main",
    ),
    "reproduce": Command(
        "reproduce the paper, and report what held", "--budget small", "forbes.commands.reproduce:main"
    ),
    "calibrate": Command("check a filter against its own model", "RUN -o figures", "forbes.commands.calibrate:main"),
    "completions": Command(
        "score sampled digit completions",
        "RUN RUN -o figures",
        "forbes.commands.completions:main",
    ),
    "complete": Command("draw completions of digits", "RUN -o picture.png", "forbes.commands.complete:main"),
    "export": Command("export a model to share", "RUN -o shared/model", "forbes.commands.export:main"),
    "figures": Command(
        "draw the paper's figures", "predictions --runs RUN RUN -o figures", "forbes.commands.figures:main"
    ),
    "data": Command(
        "fetch, build, collect and show data", "show strokes -o strokes.png", "forbes.commands.parsers.data:main"
    ),
    "doctor": Command("check this machine's software and hardware", "", "forbes.commands.doctor:main"),
}

HELP = """\
usage: forbes COMMAND ...

Learn, evaluate and use belief states of partially observable processes.

commands, each with an example (RUN is a run folder written by `forbes fit`, or a pretrained:NAME):
{commands}
options:
  --help               show this page, or that of a command
  --version            show the version
  --debug              with any command: show the traceback of an error
  --allow-module NAME  with any command: allow configurations to use classes of this Python module
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status.

    The status is 0, 1 for a report of problems (`doctor`, `data check`), 2 for an error that the user can fix, 3 for a
    training that diverged, and 128 plus its number for a signal.

    Args:
        arguments: command line without the program's name. Default: that of the process.
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in arguments
    try:
        return _run([argument for argument in arguments if argument != "--debug"])
    except (ForbesError, OSError) as error:
        if debug:
            raise
        print(f"forbes: {_sentence(error)}", file=sys.stderr)
        return error.exit_status if isinstance(error, ForbesError) else 2
    except (KeyboardInterrupt, SystemExit) as error:
        interrupt = error if isinstance(error, KeyboardInterrupt) else error.__context__  # Lightning exits with 1
        if debug or not isinstance(interrupt, KeyboardInterrupt):
            raise
        return 130


def _run(arguments: list[str]) -> int:
    """Handle --help and --version, or run a command."""
    modules = _take_modules(arguments)
    if not arguments or arguments[0] in ("--help", "-h", "help"):
        print(_help(), end="")
        return 0
    if arguments[0] == "--version":
        print(f"forbes {__version__}")
        return 0
    if arguments[0] not in COMMANDS:
        near = difflib.get_close_matches(arguments[0], COMMANDS, n=1)
        hint = f"Did you mean {near[0]}?" if near else f"There are {', '.join(COMMANDS)}"
        raise ForbesError(f"{arguments[0]}: no such command. {hint}")
    if modules:
        importlib.import_module("forbes.runs.configuration").allow_modules(modules)
    name, *rest = arguments
    if name in DESCRIPTION:
        if (page := _asked_help(name, rest)) is not None:
            print(page, end="")
            return 0
        _require_configurations(rest)
    else:  # help and wrong arguments, like a missing run folder, are reported before anything heavy is imported
        if name != "evaluate":
            _require_one_process(name)
        _parser(name).parse_args(list(itertools.takewhile("--".__ne__, rest)))
    module, function = COMMANDS[name].target.split(":")
    command: Callable[[list[str]], int | None] = getattr(importlib.import_module(module), function)
    return command(rest) or 0


def _require_one_process(name: str) -> None:
    """Refuse a command that several processes would each do as a whole."""
    processes = int(os.environ.get("WORLD_SIZE", 1)) if "TORCHELASTIC_RUN_ID" in os.environ else 1
    if processes > 1:
        raise ForbesError(f"forbes {name}: uses one process, but torchrun started {processes}. Leave torchrun out")


def _require_configurations(arguments: Sequence[str]) -> None:
    """Report a configuration, or a run to resume, that does not exist, before anything heavy is imported.

    Other wrong options need the signatures of the classes that they belong to.
    """
    from forbes.runs.configs import with_config_paths

    with_config_paths(arguments)
    for flag, run in itertools.pairwise(arguments):
        if flag == "--resume" and not run.endswith(".ckpt"):  # a checkpoint is refused as such
            existing_run(run)


def _asked_help(name: str, arguments: list[str]) -> str | None:
    """Return the short help page of a Lightning command if requested. For `--help all`, leave it to Lightning."""
    position = next((i for i, argument in enumerate(arguments) if argument in ("--help", "-h")), None)
    if position is None:
        return None
    if arguments[position + 1 : position + 2] == ["all"]:
        del arguments[position + 1]
        return None
    return help_page(name)


def _parser(name: str) -> argparse.ArgumentParser:
    """Return the parser of a command that Lightning does not parse."""
    parser: argparse.ArgumentParser = importlib.import_module(f"forbes.commands.parsers.{name}").parser()
    return parser


def _take_modules(arguments: list[str]) -> list[str]:
    """Remove each `--allow-module NAME` from the arguments and return the names."""
    modules = []
    while "--allow-module" in arguments:
        position = arguments.index("--allow-module")
        if position + 1 == len(arguments):
            raise ForbesError("--allow-module: the name is missing. Name a Python module")
        modules.append(arguments[position + 1])
        del arguments[position : position + 2]
    return modules


def _help() -> str:
    """Return the help page with the list of commands."""
    rows = []
    for name, command in COMMANDS.items():
        rows += [f"  {name:<11} {command.summary}", f"              forbes {name} {command.example}".rstrip(), ""]
    return HELP.format(commands="\n".join(rows))


def _sentence(error: Exception) -> str:
    """Return the message of an error; an `OSError`, e.g. a missing file, is described in one sentence too."""
    if isinstance(error, OSError) and error.errno in FULL:
        return str(unwritable(error.filename or "the output", error))
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {(error.strerror or type(error).__name__).lower()}"
    return str(error)
