"""Find an OpenGL backend that renders. Backends are probed in a separate process, since broken ones hang or crash.

MuJoCo reads the backend from `MUJOCO_GL` when it is first imported. By default, on a machine without a display,
dm_control uses GLFW and dies at the first frame. Here `MUJOCO_GL` is used if it is set, otherwise the first of EGL
(GPU, or Mesa on the CPU) and OSMesa (CPU) that renders.
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
"""Timeout in seconds for import and a few frames, which take 3 s on an idle machine. A broken driver hangs forever."""

_INSTALL = {
    "egl": "apt-get install libegl1 libgl1-mesa-dri; in a container with a GPU, NVIDIA_DRIVER_CAPABILITIES=all",
    "osmesa": "apt-get install libosmesa6",
}
_PROGRAM = "import sys; from forbes.envs.dm_control import measure; measure(sys.argv[1])"


class Probe(NamedTuple):
    """The result of probing a backend."""

    backend: str
    renderer: str = ""
    """GL_RENDERER, the device or software that renders; llvmpipe is the CPU."""
    frames_per_second: float = 0.0
    """Speed for a cartpole with 64 x 64 pixels, including physics."""
    problem: str = ""
    """Why it does not render; empty if it does."""

    @property
    def remedy(self) -> str:
        """What to do; empty if there is no problem."""
        if self.problem:
            return _INSTALL.get(self.backend, "unset MUJOCO_GL")
        if "llvmpipe" in self.renderer and self.backend == "egl" and shutil.which("nvidia-smi"):
            return "the GPU does not render: set NVIDIA_DRIVER_CAPABILITIES=all for the container"
        return ""


def probe_backend(backend: str, timeout: float = TIME_LIMIT) -> Probe:
    """Render a few frames with a backend in a separate process, which may hang or crash."""
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
    """Return the backend of `MUJOCO_GL`, or the first that renders. The result is cached per process.

    Raises:
        ForbesError: if no backend renders.
    """
    asked = os.environ.get("MUJOCO_GL")
    probes = []
    for backend in (asked,) if asked else BACKENDS:
        probes.append(probe_backend(backend))
        if not probes[-1].problem:
            return probes[-1]
    problems = "; ".join(f"{probe.backend}: {probe.problem}" for probe in probes)
    failure = f"MUJOCO_GL={asked} does not render" if asked else "no backend renders"
    raise ForbesError(
        f"rendering: {failure} ({problems}). Run `forbes doctor` for a remedy, or observe vectors with --no-pixels"
    )
