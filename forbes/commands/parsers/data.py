"""The arguments of `forbes data …`, and the functions that run its commands."""

import argparse
import functools
import importlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, get_args

from forbes.choices import EXPORTS, FORMATS, Dataset, Fetched, Origin, Split
from forbes.commands.arguments import ArgumentParser, positive, rate, seconds
from forbes.envs.tasks import TASKS

__all__ = ["main", "parser"]

_STORED = "folder of the episode store"


def main(argv: Sequence[str]) -> int | None:
    """Run `forbes data …`. Return 1 if `check` found damage."""
    arguments = vars(parser().parse_args(argv))
    module, function = arguments.pop("command").split(":")
    command: Callable[..., int | None] = getattr(importlib.import_module(module), function)
    return command(**arguments)


def parser() -> argparse.ArgumentParser:
    """Return the parser of `forbes data`. It sets `command` to the `module:function` to run."""
    of_data = _Parser()
    _add_strokes(of_data)
    _add_collect(of_data)
    _add_episodes(of_data)
    _add_imports(of_data)
    return of_data


class _Parser(ArgumentParser):
    """A parser with subcommands and an example for each."""

    def __init__(self) -> None:
        super().__init__("forbes data", "Build, fetch, compare, collect and show data.", "examples:")
        self._commands = self.add_subparsers(required=True, metavar="COMMAND", parser_class=ArgumentParser)

    def add(self, name: str, target: str, summary: str, example: str) -> argparse.ArgumentParser:
        """Add a subcommand and its example."""
        epilog = f"example: forbes data {example}"
        command = self._commands.add_parser(name, help=summary, description=summary, epilog=epilog)
        command.set_defaults(command=target)
        self.epilog = f"{self.epilog}\n  forbes data {example}"
        return command


def _add_strokes(of_data: _Parser) -> None:
    summary = "Extract the pen paths of all MNIST digits from their images, bit-identical to the bundled set."
    example = "build-strokes --images package/data"
    build = of_data.add("build-strokes", "forbes.commands.data:build_strokes", summary, example)
    build.add_argument("--images", type=Path, required=True, help="folder with the four IDX files of MNIST, unpacked")
    build.add_argument("-o", "--output", type=Path, help="file to write (default: the bundled one)")

    summary = "Train the digit classifiers on both sets of strokes, and print their scores on test digits."
    example = "build-classifiers -o classifiers.npz"
    train = of_data.add("build-classifiers", "forbes.commands.data:build_classifiers", summary, example)
    train.add_argument("-o", "--output", type=Path, help="file to write (default: the bundled one)")

    summary = "Download a data set that is not bundled, verify its hash, and store it."
    get = of_data.add("fetch", "forbes.commands.data:fetch", summary, "fetch strokes --from sequences.tar.gz")
    get.add_argument("dataset", choices=get_args(Fetched), help="the paper's strokes, or learning curves of agents")
    copies = "for strokes the tarball, its extracted folder or an .npz; for curves one of the files"
    get.add_argument("--from", dest="from_", type=Path, metavar="PATH", help=f"local copy to use; {copies}")

    summary = "Print measures of similarity of two stroke files of the same digits."
    example = "compare-strokes data/strokes.npz dejong-strokes.npz"
    compare = of_data.add("compare-strokes", "forbes.commands.data:compare_strokes", summary, example)
    compare.add_argument("one", type=Path, help="first stroke file")
    compare.add_argument("other", type=Path, help="second stroke file, of the same digits")
    compare.add_argument("--split", choices=("train", "test"), default="test", help="digits to compare (default: test)")

    summary = "Draw digits as they are written: frames coloured from the first point to the last, and the strokes."
    example = "show strokes --split test --index 0 1 2 -o strokes.png"
    look = of_data.add("show", "forbes.commands.data:show", summary, example)
    look.add_argument("dataset", choices=get_args(Dataset))
    look.add_argument("--split", choices=get_args(Split), default="test", help="split of the digits (default: test)")
    look.add_argument(
        "--index", type=int, nargs="+", default=[0, 1, 2], help="indices of the digits in their split (default: 0 1 2)"
    )
    look.add_argument(
        "-o", "--output", type=Path, default=Path("strokes.png"), help="image file to write (default: strokes.png)"
    )
    look.add_argument("--origin", choices=get_args(Origin), default="bundled", help="set of strokes (default: bundled)")
    look.add_argument("--path", type=Path, help="stroke file to read instead of the origin's")


def _add_collect(of_data: _Parser) -> None:
    summary = "Play episodes in a separate process and store them. If interrupted, the same command resumes."
    example = "collect --task cartpole_swingup --episodes 40 -o episodes/cartpole"
    play = of_data.add("collect", "forbes.commands.collect:collect", summary, example)
    play.epilog = (
        f"tasks:\n{TASKS}\n\n{play.epilog}\n"
        "         forbes data collect --policy RUN --episodes 80 -o episodes/cartpole    # 40 more, by an agent"
    )
    play.add_argument("--task", help="task, one of those below; not with the agent of a run")
    play.add_argument(
        "--episodes",
        type=positive,
        default=10,
        help="number of episodes in DIR at the end, including earlier ones (default: 10)",
    )
    play.add_argument(
        "--policy",
        default="random",
        metavar="random|RUN",
        help="random policy, or the agent of a run, which explores (default: random)",
    )
    play.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help=_STORED)
    play.add_argument("--seed", type=int, default=0, help="episode n is a function of the seed and n (default: 0)")
    play.add_argument(
        "--workers",
        type=positive,
        default=1,
        help="number of episodes to play at the same time, each in its own process (default: 1)",
    )
    play.add_argument(
        "--action-repeat",
        type=positive,
        help="number of steps that each action is repeated (default: 2 in DeepMind Control, 1 in Gymnasium)",
    )
    play.add_argument(
        "--pixels",
        action=argparse.BooleanOptionalAction,
        help="observe rendered images instead of measurements (default: images in DeepMind Control only)",
    )
    play.add_argument(
        "--size",
        type=positive,
        help="side of the images in pixels (default: 64 if they are rendered, else the environment's own)",
    )
    play.add_argument("--part", help="in Gymnasium: entry of a Dict observation to use (default: all of them)")
    play.add_argument(
        "--parts", nargs="+", metavar="PART", help="in Gymnasium: entries of a Dict to observe, each as a part"
    )
    play.add_argument(
        "--proprio", action="store_const", const=True, help="in DeepMind Control: observe the measurements, too"
    )
    play.add_argument(
        "--camera", type=int, help="in DeepMind Control: index of the camera (default: 0, for quadruped 2)"
    )
    play.add_argument(
        "--fast", action="store_const", const=True, help="in DeepMind Control: no shadows, which changes the pixels"
    )
    _add_views(play)
    play.add_argument(
        "--time-limit", type=positive, metavar="STEPS", help="truncate longer episodes (default: 100,000)"
    )
    play.add_argument("--timeout", type=seconds, help="seconds to wait for the environment (default: 60)")


def _add_views(play: argparse.ArgumentParser) -> None:
    """Add the options that make a task less observable."""
    group = play.add_argument_group("less observable", "applied in the order in which they are given")
    add = functools.partial(group.add_argument, action=_InOrder)
    names = "names of parts, e.g. velocities, or indices from 0"
    add("--hide", nargs="+", type=_part, metavar="PART", help=f"leave out dimensions of vectors: {names}")
    add("--flicker", type=float, metavar="P", help="blank each observation with probability P")
    sides = ("LEFT", "TOP", "RIGHT", "BOTTOM")
    add("--occlude", nargs=4, type=float, metavar=sides, help="blank a box of each image, in fractions of its size")
    add("--noise", type=float, metavar="STD", help="add Gaussian noise; for images, as a fraction of white")
    add("--delay", type=int, metavar="STEPS", help="show each observation so many agent steps late")
    add("--blank-until", type=int, metavar="STEPS", help="blank the first observations of each episode")


class _InOrder(argparse.Action):
    """Stores values so that the order of the arguments is that of the namespace."""

    def __call__(self, parser: object, namespace: argparse.Namespace, values: Any, option: str | None = None) -> None:
        """Move the argument to the end of the namespace."""
        vars(namespace).pop(self.dest, None)
        setattr(namespace, self.dest, values)


def _part(text: str) -> str | int:
    return int(text) if text.isdecimal() else text


def _add_episodes(of_data: _Parser) -> None:
    summary = "Print a summary of an episode store, and draw frames of three episodes."
    look = of_data.add("info", "forbes.commands.episodes:info", summary, "info episodes/cartpole")
    look.add_argument("path", type=Path, metavar="DIR", help=_STORED)
    look.add_argument("-o", "--output", type=Path, help="image file to write (default: DIR/frames.png)")

    summary = "Verify every file of an episode store, move damaged ones to quarantine/; exit status 1 if there are any."
    verify = of_data.add("check", "forbes.commands.episodes:check", summary, "check episodes/cartpole")
    verify.add_argument("path", type=Path, metavar="DIR", help=_STORED)


def _add_imports(of_data: _Parser) -> None:
    summary = "Import recorded episodes to a new store. If interrupted, the same command resumes."
    example = "import recordings/npz -o episodes/mine --image image --resize 64"
    take = of_data.add("import", "forbes.commands.imports:import_", summary, example)
    take.add_argument(
        "path", metavar="FROM", help="file or folder of the recorded episodes, or the id of a Minari data set"
    )
    take.add_argument(
        "-o", "--output", type=Path, required=True, metavar="DIR", help=f"{_STORED}, which must not exist"
    )
    take.add_argument("--format", choices=FORMATS, help="format of FROM (default: the one that recognises it)")
    several = "; images and vectors, or several images, become parts of the observation"
    take.add_argument("--image", metavar="KEY", nargs="+", help=f"keys of images of the observation{several}")
    take.add_argument("--proprio", metavar="KEY", nargs="+", help="keys of vectors of the observation, joined to one")
    take.add_argument("--action", metavar="KEY", help="key of the action (default: by the format's usual name)")
    sizes = "options of each choice in a discrete action, e.g. 3 2 (default: as the format or the values say)"
    take.add_argument("--action-sizes", type=positive, nargs="+", metavar="N", help=sizes)
    take.add_argument("--reward", metavar="KEY", help="key of the reward (default: by the usual name, else all are 0)")
    take.add_argument("--resize", type=positive, metavar="PIXELS", help="side of the images (default: as they are)")
    take.add_argument("--fps", type=rate, help="steps per second to keep, a fraction of the data's (default: all)")
    take.add_argument("--dry-run", action="store_true", help="print the table of what there is, and import nothing")

    summary = "Export the episodes of a store to another format, without loss."
    give = of_data.add(
        "export", "forbes.commands.imports:export", summary, "export episodes/mine --format hdf5 -o mine.hdf5"
    )
    give.add_argument("path", type=Path, metavar="STORE", help=_STORED)
    give.add_argument("--format", choices=EXPORTS, required=True, help="format to write")
    give.add_argument("-o", "--output", type=Path, required=True, help="file or folder to write, which must not exist")
