"""Processor time of short commands, start-up and all, in turns: of this checkout, and of others to compare with.

python benchmarks/start.py                       # this checkout
python benchmarks/start.py --roots . ../before   # in turns with another one
"""

import argparse
import os
import resource
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

RUN = "pretrained:strokes-forbes"
COMMANDS = {
    "import torch": ["-c", "import torch"],
    "import torch.optim, an Adam": ["-c", "import torch; torch.optim.Adam([torch.zeros(1, requires_grad=True)])"],
    "import lightning": ["-c", "import lightning"],
    "evaluate absent": ["-m", "forbes", "evaluate", "absent"],
    "fit absent": ["-m", "forbes", "fit", "absent"],
    "evaluate": ["-m", "forbes", "evaluate", RUN, "--scores", "elbo", "--sequences", "20"],
    "complete": ["-m", "forbes", "complete", RUN, "-o", "a.png", "--index", "0", "--samples", "1"],
    "figures predictions": ["-m", "forbes", "figures", "predictions", "--runs", RUN, "-o", ".", "--index", "0"],
    "fit, one update": ["-m", "forbes", "fit", "strokes/forbes", "--trainer.fast_dev_run", "1"],
}


def seconds(arguments, root, folder):
    """User and system time of a Python process with one thread; a command that should not fail must not."""
    environment = os.environ | {"PYTHONPATH": str(root.resolve()), "OMP_NUM_THREADS": "1"}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    done = subprocess.run([sys.executable, *arguments], cwd=folder, env=environment, check=False, **quiet)
    if done.returncode != (2 if "absent" in arguments else 0):
        raise SystemExit(f"{' '.join(arguments)}: ended with status {done.returncode} in {root}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main():
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--roots", nargs="+", type=Path, default=[Path(__file__).parents[1]], help="checkouts")
    parser.add_argument("--commands", nargs="+", choices=COMMANDS, default=[*COMMANDS], metavar="NAME")
    parser.add_argument("--repeats", type=int, default=5)
    args = parser.parse_args()
    print(f"| command | {' | '.join(map(str, args.roots))} |\n|---|{'---:|' * len(args.roots)}")
    for name in args.commands:
        found = [[] for _ in args.roots]
        with tempfile.TemporaryDirectory() as folder:
            for _ in range(args.repeats):
                for times, root in zip(found, args.roots, strict=True):
                    times.append(seconds(COMMANDS[name], root, folder))
        print(f"| {name} | {' | '.join(f'{statistics.median(times):.2f}' for times in found)} |", flush=True)


if __name__ == "__main__":
    main()
