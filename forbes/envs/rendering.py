"""Which OpenGL backend renders on this machine: tried in a process of its own, since a broken one hangs or crashes.

MuJoCo reads the backend from `MUJOCO_GL` when it is first imported. Left to itself on a machine without a display,
dm_control takes GLFW and dies at the first frame. Here the user's `MUJOCO_GL` counts; without it, the first of EGL (a
GPU, or Mesa on the processor) and OSMesa (the processor) that renders.
"""

import json
import os
import shutil
import subprocess
import sys
from functools import lru_cache
from typing import NamedTuple

from forbes.errors import ForbesError

__all__ = ["BACKENDS", "Probe", "choose_backend", "probe_backend"]

BACKENDS = ("egl", "osmesa")
TIME_LIMIT = 60.0
"""Seconds for import, first frame and a few more; it takes 3 on an idle machine. A broken driver hangs for ever."""

_INSTALL = {
    "egl": "apt-get install libegl1 libgl1-mesa-dri; in a container with a GPU, NVIDIA_DRIVER_CAPABILITIES=all",
    "osmesa": "apt-get install libosmesa6",
}
_PROGRAM = "import sys; from forbes.envs.dm_control import measure; measure(sys.argv[1])"


class Probe(NamedTuple):
    """What became of a backend."""

    backend: str
    renderer: str = ""
    """GL_RENDERER: which device or software draws; llvmpipe is the processor."""
    frames_per_second: float = 0.0
    """Of 64 x 64 pixels of a cartpole, physics included."""
    problem: str = ""
    """Why it does not render; empty where it does."""

    @property
    def remedy(self) -> str:
        """What to do; empty where all is well."""
        if self.problem:
            return _INSTALL.get(self.backend, "unset MUJOCO_GL")
        if "llvmpipe" in self.renderer and self.backend == "egl" and shutil.which("nvidia-smi"):
            return "the GPU does not draw: give the container NVIDIA_DRIVER_CAPABILITIES=all"
        return ""


def probe_backend(backend: str, timeout: float = TIME_LIMIT) -> Probe:
    """Render a few frames with a backend in a process of its own, which may hang or crash."""
    try:
        done = subprocess.run(
            [sys.executable, "-c", _PROGRAM, backend],
            env=os.environ | {"MUJOCO_GL": backend},
            capture_output=True,
            text=True,
            timeout=timeout,
        )
    except subprocess.TimeoutExpired:
        return Probe(backend, problem=f"no frame within {timeout:g} s")
    if done.returncode != 0:
        lines = done.stderr.strip().splitlines()
        return Probe(backend, problem=lines[-1] if lines else f"it dies with exit code {done.returncode}")
    renderer, frames_per_second = json.loads(done.stdout.splitlines()[-1])
    return Probe(backend, renderer, frames_per_second)


@lru_cache(maxsize=1)
def choose_backend() -> Probe:
    """Return the backend of `MUJOCO_GL`, else the first that renders; each process asks once, an environment's too.

    Raises:
        ForbesError: when none renders.
    """
    asked = os.environ.get("MUJOCO_GL")
    probes = []
    for backend in (asked,) if asked else BACKENDS:
        probes.append(probe_backend(backend))
        if not probes[-1].problem:
            return probes[-1]
    problems = "; ".join(f"{probe.backend}: {probe.problem}" for probe in probes)
    failure = f"MUJOCO_GL={asked} gives no picture" if asked else "no backend gives a picture"
    raise ForbesError(
        f"rendering: {failure} ({problems}). `forbes doctor` has the remedy; vectors need no rendering: --no-pixels"
    )
