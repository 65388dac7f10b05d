"""Tasks of the DeepMind Control Suite (Tassa et al., 2018, arXiv 1801.00690), with pixels or state vectors."""

import difflib
import json
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray

from forbes.envs.base import Environment, Step, repeat, require_repeat, scale_action
from forbes.envs.images import RENDERED_SIZE
from forbes.envs.rendering import choose_backend
from forbes.envs.views import VELOCITIES
from forbes.errors import ForbesError, require_at_least
from forbes.shapes import Observed

__all__ = ["DOMAINS", "DeepMindControl", "environment_variable", "measure"]

DOMAINS = (
    *("acrobot", "ball_in_cup", "cartpole", "cheetah", "dog", "finger", "fish", "hopper", "humanoid", "humanoid_CMU"),
    *("lqr", "manipulator", "pendulum", "point_mass", "quadruped", "reacher", "stacker", "swimmer", "walker"),
)
"""Domains of the suite, with which the names of its tasks begin."""

_NO_RENDERING = "disable"
"""Value of MUJOCO_GL for which dm_control loads no backend."""
_NO_BOUND = 1e10
"""MuJoCo's largest number, which the suite uses for an actuator without bounds."""
_MOVING = (
    *("velocity", "arm_vel", "object_vel", "box_vel", "com_velocity", "torso_velocity", "torso_com_velocity"),
    *("body_velocities", "joint_velocites", "touch", "touch_sensors", "foot_forces", "force_torque", "imu"),
    "inertial_sensors",
)
_VELOCITY = {
    **dict.fromkeys(_MOVING, slice(None)),
    "egocentric_state": slice(16, 32),  # the quadruped's qpos, qvel and actuators
    "ball_state": slice(3, None),  # the position and the velocity of the dog's ball
}
"""The suite's measurements that depend on velocities, and which of their numbers: contact forces do, too."""
_FRAMES = 10  # number of frames to measure the speed


class DeepMindControl(Environment):
    r"""A task of the suite, named by domain and task, e.g. `cartpole_swingup`, `ball_in_cup_catch`.

    An action in [-1, 1]^A is scaled to the bounds of the actuators and repeated for R frames, whose rewards are summed:

    .. math:: r_{t+1} = \sum_{i=1}^{R} r(s_{t,i}, a_t)

    The time limit of 1000 frames is a truncation, which the suite marks by a discount of 1. The two tasks without a
    time limit, `lqr`, have unbounded actions and are refused. Defaults are those of Dreamer (arXiv 1912.01603): two
    frames, 64 x 64 pixels, camera 0, for the quadruped camera 2.

    Args:
        task: name of the task.
        pixels: observe images, uint8 `(3, size, size)`; otherwise the task's measurements, float32 `(O,)`, in the
            suite's order.
        action_repeat: number of frames per action, R.
        camera: index of the camera. This, `size` and `fast` are for images.
        size: side of the images in pixels; 64 by default.
        fast: render without shadows, which on a CPU take most of the time. This changes the pixels, so it is not for
            published results. Multisampling stays on: without it a thin pole vanishes in a small image.
        proprio: with `pixels`, observe the measurements too: the parts `camera` and `proprio`.
        backend: OpenGL backend that is known to render. Default: the one of `choose_backend`.

    Raises:
        ForbesError: for an unknown task or camera, unbounded actions, options of images without `pixels`, or if no
            backend renders.

    Example:
        >>> environment = forbes.DeepMindControl("cartpole_swingup", pixels=False)
        >>> environment.reset(seed=0).observation.shape
        (5,)
        >>> environment.step(torch.zeros(1).numpy()).truncated
        False
    """

    def __init__(
        self,
        task: str,
        pixels: bool = True,
        action_repeat: int = 2,
        camera: int | None = None,
        size: int | None = None,
        fast: bool = False,
        proprio: bool = False,
        backend: str | None = None,
    ) -> None:
        require_repeat(task, action_repeat)
        if proprio and not pixels:
            raise ForbesError(f"{task}: proprio adds the measurements to images, expected pixels. Leave proprio out")
        for name, value in (("camera", camera), ("size", size), ("fast", fast or None)):
            if value is not None and not pixels:
                raise ForbesError(f"{task}: {name} is for images, expected pixels. Leave {name} out")
        size = RENDERED_SIZE if size is None else size
        require_at_least(1, task, size=size)
        self.task, self.pixels, self.action_repeat, self.size, self.fast = task, pixels, action_repeat, size, fast
        self.proprio = proprio
        self.backend = (backend or choose_backend().backend) if pixels else _NO_RENDERING
        self._environment = _load(task, self.backend)
        spec = self._environment.action_spec()
        self._low, self._high, self.action_dim = spec.minimum, spec.maximum, spec.shape[0]
        if (self._high >= _NO_BOUND).any():
            raise ForbesError(
                f"{task}: its actions are unbounded, so [-1, 1] cannot be scaled to them. Choose another task"
            )
        self.camera = camera if camera is not None else 2 if task.startswith("quadruped") else 0
        self.observation_shape = (3, size, size)
        if pixels:
            self._prepare_rendering()
        if proprio or not pixels:
            measured = _measurements(self._environment.reset()).shape
            self.observation_shape = {"camera": (3, size, size), "proprio": measured} if proprio else measured

    def _prepare_rendering(self) -> None:
        """Set the rendering options that cannot be changed after the first frame."""
        model = self._environment.physics.model
        if not 0 <= self.camera < model.ncam:
            raise ForbesError(f"{self.task}: has no camera {self.camera}, expected 0 to {model.ncam - 1}. Choose one")
        model.vis.global_.offwidth = model.vis.global_.offheight = self.size  # the default buffer costs 20 % more
        if self.fast:
            model.vis.quality.shadowsize = 0

    def reset(self, seed: int) -> Step:
        """Start the episode of a seed. The task's generator is its only source of randomness."""
        self._environment.task.random.seed(seed)
        return Step(self._observe(self._environment.reset()))

    def step(self, action: NDArray[np.float32]) -> Step:
        """Apply an action, float32 `(A,)`; only the last frame is rendered."""
        scaled = scale_action(action, self._low, self._high)
        last: Any = None

        def frame() -> Step:
            nonlocal last
            last = self._environment.step(scaled)
            ends = last.last()
            return Step(np.empty(0), last.reward, ends and last.discount == 0, ends and last.discount != 0)

        return repeat(frame, self.action_repeat)._replace(observation=self._observe(last))

    def _observe(self, time_step: Any) -> Observed:
        if not self.pixels:
            return _measurements(time_step)
        image = self._rendered()
        return {"camera": image, "proprio": _measurements(time_step)} if self.proprio else image

    def _rendered(self) -> NDArray[np.uint8]:
        frame = self._environment.physics.render(self.size, self.size, camera_id=self.camera)  # (H, W, 3)
        if (frame == frame[0, 0]).all():
            raise RuntimeError(f"{self.backend} renders a frame of one colour")
        return np.ascontiguousarray(frame.transpose(2, 0, 1))  # (3, H, W)

    def named_parts(self) -> dict[str, list[int]]:
        """Return the suite's measurements by name, and `velocities`: all numbers that depend on velocities."""
        if self.pixels and not self.proprio:
            return {}
        parts: dict[str, list[int]] = {}
        for name, spec in self._environment.observation_spec().items():
            first = sum(map(len, parts.values()))
            parts[name] = list(range(first, first + int(np.prod(spec.shape))))
        velocities = [index for name, part in parts.items() if name in _VELOCITY for index in part[_VELOCITY[name]]]
        return parts | {VELOCITIES: velocities}

    def describe(self) -> dict[str, Any]:
        """Return task, rendering options and versions."""
        made_by = {name: version(name) for name in ("dm-control", "mujoco")}
        if not self.pixels:
            return {"task": self.task, "pixels": False, "made_by": made_by}
        made_by |= {"backend": self.backend, "gl_renderer": self._gl_renderer()}
        shown = {"proprio": True} if self.proprio else {}
        return {
            "task": self.task,
            "pixels": True,
            "camera": self.camera,
            "fast": self.fast,
            **shown,
            "made_by": made_by,
        }

    def _gl_renderer(self) -> str:
        """Return the name of the device or software that renders."""
        from OpenGL import GL

        with self._environment.physics.contexts.gl.make_current() as context:
            name: bytes = context.call(GL.glGetString, GL.GL_RENDERER)
        return name.decode()


def _measurements(time_step: Any) -> NDArray[np.float32]:
    """Return the task's measurements, float32 `(O,)`."""
    measured = [np.ravel(part) for part in time_step.observation.values()]
    vector: NDArray[np.float32] = np.concatenate(measured).astype(np.float32)
    return vector


def _load(task: str, backend: str) -> Any:
    """Import the suite for a backend and load a task.

    Raises:
        ForbesError: if it was imported for another backend, or there is no such task.
    """
    with environment_variable("MUJOCO_GL", backend):  # read at the first import
        from dm_control import _render, suite
    if backend not in (_NO_RENDERING, _render.BACKEND):
        raise ForbesError(
            f"{task}: this process has imported dm_control with MUJOCO_GL={_render.BACKEND}, expected {backend}. "
            "Do not import it before, or use EnvironmentProcess"
        )
    names = {f"{domain}_{name}": (domain, name) for domain, name in suite.ALL_TASKS}
    if task not in names:
        near = difflib.get_close_matches(task, names, n=3, cutoff=0.5)
        hint = f"Did you mean {' or '.join(near)}?" if near else "`forbes data collect --help` lists the tasks"
        raise ForbesError(f"{task}: no such task. {hint}")
    return suite.load(*names[task])


@contextmanager
def environment_variable(name: str, value: str) -> Iterator[None]:
    """Set an environment variable inside the `with` block."""
    before = os.environ.get(name)
    os.environ[name] = value
    try:
        yield
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before


def measure(backend: str) -> None:
    """Print GL_RENDERER and frames per second as JSON. Runs in the process of `probe_backend`.

    Raises:
        RuntimeError: if the same state is rendered as two different frames.
    """
    environment = DeepMindControl("cartpole_balance", action_repeat=1, backend=backend)
    if (environment.reset(0).observation != environment.reset(0).observation).any():
        raise RuntimeError("the same state is rendered as two different frames")
    action, began = np.zeros(environment.action_dim, np.float32), time.perf_counter()
    for _ in range(_FRAMES):
        environment.step(action)
    frames_per_second = _FRAMES / (time.perf_counter() - began)
    print(json.dumps([environment.describe()["made_by"]["gl_renderer"], frames_per_second]))
