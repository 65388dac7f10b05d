"""`forbes doctor`: report the machine's software, hardware and data, with a remedy for each problem."""

import os
import platform
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import NamedTuple

import torch
from rich.console import Console
from rich.table import Column, Table

import forbes
from forbes.commands.launchers.local import num_cpus
from forbes.commands.parsers.doctor import parser
from forbes.data.download import curves_paths
from forbes.data.strokes.classifiers import classifiers_path
from forbes.data.strokes.dejong import dejong_path
from forbes.data.strokes.source import bundled_path
from forbes.envs.rendering import BACKENDS, probe_backend
from forbes.runs.configs import config_folder

__all__ = ["main"]

_DRIVER_LIMIT = 30.0
"""Timeout of nvidia-smi in seconds; it takes a few seconds to wake a GPU."""
REQUIRED = (
    "torch",
    "lightning",
    "torchmetrics",
    "jsonargparse",
    "numpy",
    "matplotlib",
    "pandas",
    "dm-control",
    "mujoco",
)
OPTIONAL = {
    "scikit-image": "build",
    "tensorboard": "tracking",
    "gymnasium": "gym",
}


class Finding(NamedTuple):
    """One line of the report."""

    name: str
    value: str
    remedy: str = ""
    """What to do; empty if there is no problem."""
    fatal: bool = False
    """Whether `make fit` cannot work."""


def main(arguments: Sequence[str]) -> int:
    """Print the report. Return 0 if `make fit` can work here, else 1."""
    parser().parse_args(arguments)
    table = Table("", Column("found", overflow="fold"), Column("what to do", overflow="fold"), box=None)
    findings = [*_software(), *_hardware(), *_rendering(), *_data()]
    for finding in findings:
        table.add_row(finding.name, finding.value, finding.remedy)
    Console().print(table)
    return int(any(finding.fatal for finding in findings))


def _software() -> Iterator[Finding]:
    yield Finding("forbes", f"{forbes.__version__}, Python {platform.python_version()}")
    for name in REQUIRED:
        found = _version(name)
        yield Finding(name, found or "not installed", "" if found else f"pip install {name}", fatal=found is None)
    for name, extra in OPTIONAL.items():
        found = _version(name)
        yield Finding(name, found or "not installed (optional)", "" if found else f"pip install 'forbes\\[{extra}]'")


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _hardware() -> Iterator[Finding]:
    threads = torch.get_num_threads()
    cpus = num_cpus()
    yield Finding("CPUs", f"{cpus}, torch uses {threads} threads", "set OMP_NUM_THREADS" if threads > cpus else "")
    yield from _gpus()
    free = shutil.disk_usage(".").free / 2**30
    yield Finding(
        "free disk",
        f"{free:.1f} GiB here",
        "free some space: a run takes up to 0.1 GiB" if free < 1 else "",
        free < 0.1,
    )


def _gpus() -> Iterator[Finding]:
    """List the GPUs that torch can use, and the driver, which may be installed without a usable GPU."""
    for number in range(torch.cuda.device_count()):
        properties = torch.cuda.get_device_properties(number)
        yield Finding(f"GPU {number}", f"{properties.name}, {properties.total_memory / 2**30:.0f} GiB")
    if not torch.cuda.is_available():
        yield Finding("GPU", "none that torch can use (optional)")
    if program := shutil.which("nvidia-smi"):
        remedy = "" if torch.cuda.is_available() else "install torch for CUDA, if there is a GPU (https://pytorch.org)"
        built = f"torch is built for CUDA {torch.version.cuda or 'none'}"
        yield Finding("GPU driver", f"{_driver(program)}; {built}", remedy)


def _driver(program: str) -> str:
    """Return the driver version according to nvidia-smi, which hangs if the driver is broken."""
    asked = [program, "--query-gpu=driver_version", "--format=csv,noheader"]
    try:
        answer = subprocess.run(asked, capture_output=True, text=True, check=False, timeout=_DRIVER_LIMIT)
    except subprocess.TimeoutExpired:
        return f"nvidia-smi hangs, no answer within {_DRIVER_LIMIT:g} s"
    return (answer.stdout.strip() or answer.stderr.strip() or "nvidia-smi prints nothing").splitlines()[0]


def _rendering() -> Iterator[Finding]:
    """Try every rendering backend, that of MUJOCO_GL first."""
    asked = os.environ.get("MUJOCO_GL")
    if asked:
        yield Finding("MUJOCO_GL", asked)
    for backend in dict.fromkeys((asked, *BACKENDS) if asked else BACKENDS):
        probe = probe_backend(backend)
        value = probe.problem or f"{probe.renderer}, {probe.frames_per_second:.0f} frames of 64 x 64 per second"
        yield Finding(f"rendering, {backend}", value, probe.remedy)


def _data() -> Iterator[Finding]:
    yield Finding("configurations", str(config_folder()))
    for name, path, remedy, needed in (
        ("strokes, bundled", bundled_path(), "forbes data build-strokes --images DIR", True),
        ("digit classifiers", classifiers_path(), "reinstall forbes, if you need forbes completions", False),
        ("strokes, de Jong", dejong_path(), "forbes data fetch strokes (optional: the paper's data set)", False),
        *(("curves to compare with", path, "forbes data fetch curves (optional)", False) for path in curves_paths()),
    ):
        found = path.is_file()
        yield Finding(name, str(path) if found else f"no {path}", "" if found else remedy, needed and not found)
