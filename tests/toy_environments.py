"""Environments of a few lines, for what goes wrong and for what must come out; spawned processes import this module."""

import gc
import os
import signal
import sys
import time
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from forbes.envs.base import Environment, Step
from forbes.envs.dm_control import DeepMindControl


class Echo(Environment):
    """The next observation and reward are the action; the second number of the observation is the time."""

    observation_shape, action_dim = (2,), 1

    def __init__(self, steps=6, ends=False):
        self.steps, self.ends = steps, ends

    def reset(self, seed):
        self.time = 0
        return Step(np.array([seed % 97, 0], np.float32))

    def step(self, action):
        self.time += 1
        done = self.time == self.steps
        seen = np.array([action[0], self.time], np.float32)
        return Step(seen, float(action[0]), done and self.ends, done and not self.ends, frames=3)

    def describe(self):
        return {"task": "Echo", "torch": "torch" in sys.modules, "process": os.getpid()}


class Parrot(Echo):
    """An echo that says of itself what stays the same, so that its episodes may be stored together."""

    def describe(self):
        return {"task": "Parrot", "steps": self.steps}


class Endless(Parrot):
    """Never ends."""

    def __init__(self):
        super().__init__(steps=None)


class Troubled(Echo):
    """An echo that goes wrong at its third step, `times` times in all; `ledger` is a file that counts them."""

    def __init__(self, trouble, ledger, times=1):
        super().__init__()
        self.trouble, self.ledger, self.times = trouble, Path(ledger), times

    def step(self, action):
        step = super().step(action)
        if self.time == 3 and self.count() < self.times:
            with self.ledger.open("a") as file:
                file.write("x")
            return getattr(self, self.trouble)(step)
        return step

    def count(self):
        return len(self.ledger.read_text()) if self.ledger.exists() else 0

    def raises(self, step):
        raise ArithmeticError("the physics\nhas exploded")

    def hangs(self, step):
        time.sleep(3600)

    def dies(self, step):
        os.kill(os.getpid(), signal.SIGKILL)

    def leaves(self, step):
        os._exit(7)

    def rewards_nan(self, step):
        return step._replace(reward=float("nan"))

    def sees_nan(self, step):
        return step._replace(observation=np.array([np.nan, 0], np.float32))

    def sees_another_shape(self, step):
        return step._replace(observation=np.zeros(3, np.float32))

    def sees_doubles(self, step):
        return step._replace(observation=np.zeros(2))


class Unready(Echo):
    """An echo that raises or hangs where it is built, or at a reset."""

    def __init__(self, where, trouble):
        super().__init__()
        self.where, self.trouble = where, trouble
        self.begin("start")

    def reset(self, seed):
        self.begin("reset")
        return super().reset(seed)

    def begin(self, where):
        if where == self.where:
            getattr(Troubled, self.trouble)(self, None)


class Unbuildable(Unready):
    """Raises where it is built."""

    def __init__(self):
        super().__init__("start", "raises")


class Severed(Echo):
    """Dies at a reset, when so many bytes of a longer answer are sent."""

    def __init__(self, sent):
        super().__init__()
        self.sent = sent

    def reset(self, seed):
        if self.sent:
            (pipe,) = (file for file in gc.get_objects() if isinstance(file, Connection) and not file.closed)
            os.write(pipe.fileno(), (2 * self.sent).to_bytes(4, "big") + bytes(self.sent))
        os._exit(7)


class Hanging(Echo):
    """Never answers its third action."""

    def step(self, action):
        step = super().step(action)
        return Troubled.hangs(self, step) if self.time == 3 else step


class Weary(Troubled):
    """Goes wrong in three episodes in a row, after so many healthy ones; `ledger` counts them all."""

    def __init__(self, trouble, ledger, healthy):
        super().__init__(trouble, ledger)
        self.healthy = healthy

    def reset(self, seed):
        with self.ledger.open("a") as file:
            file.write("x")
        return super().reset(seed)

    def step(self, action):
        step = Echo.step(self, action)
        ill = self.time == 3 and self.healthy < self.count() <= self.healthy + 3
        return getattr(self, self.trouble)(step) if ill else step

    def describe(self):
        return {"task": "Weary"}


class Pictures(Environment):
    """A white square that moves to the right; its column is the time."""

    observation_shape, action_dim = (3, 8, 8), 2

    def reset(self, seed):
        self.time = 0
        return Step(self.picture())

    def step(self, action):
        self.time += 1
        return Step(self.picture(), 1.0, truncated=self.time == 4)

    def picture(self):
        frame = np.zeros((3, 8, 8), np.uint8)
        frame[:, 2, self.time] = 255
        return frame


class Screen(Pictures):
    """Looks like a task of DeepMind Control, and has its options."""

    def __init__(self, size=64, fast=False, action_repeat=2):
        self.observation_shape = (3, size, size)

    def picture(self):
        frame = np.zeros(self.observation_shape, np.uint8)
        frame[:, 2, self.time] = 255
        return frame

    def describe(self):
        return {"task": "Screen"}


class ScreenWithJoints(Screen):
    """The same with proprioception."""

    def __init__(self, proprio=True, size=64, fast=False, action_repeat=2):
        super().__init__(size)
        self.size, self.observation_shape = self.observation_shape, {"camera": self.observation_shape, "proprio": (4,)}

    def picture(self):
        frame = np.zeros(self.size, np.uint8)
        frame[:, 2, self.time] = 255
        return {"camera": frame, "proprio": np.full(4, self.time, np.float32)}


class Slide(Environment):
    """A square that the first action moves to the left or right, on a colour of its own; it is paid for its place."""

    observation_shape, action_dim = (3, 8, 8), 2

    def __init__(self, steps=9):
        self.steps = steps

    def reset(self, seed):
        self.time, self.place, self.colour = 0, 3.0, seed % 200
        return Step(self.picture())

    def step(self, action):
        self.time += 1
        self.place = float(np.clip(self.place + 2 * action[0], 0, 7))
        return Step(self.picture(), self.place, truncated=self.time == self.steps, frames=2)

    def picture(self):
        frame = np.full((3, 8, 8), self.colour, np.uint8)
        frame[:, 3:5, round(self.place)] = np.array([[255], [20], [128]], np.uint8)
        frame[:, 0, 0] = self.time  # so that no two frames are the same
        return frame

    def describe(self):
        return {"task": "Slide", "steps": self.steps}


class EvaluatedRun(DeepMindControl):
    """Says how large the buffer is that it renders into."""

    def describe(self):
        buffer = self._environment.physics.model.vis.global_
        return {"task": self.task, "buffer": [buffer.offwidth, buffer.offheight]}


class Robot(Environment):
    """Its camera shows where it is, its joint how fast it moves and the time: an observation of two parts."""

    action_dim = 1

    def __init__(self, steps=9):
        self.observation_shape = {"joint": (2,), "camera": (1, 6, 6)}
        self.steps = steps

    def reset(self, seed):
        self.time, self.place, self.speed = 0, float(seed % 6), 0.0
        return Step(self.seen())

    def step(self, action):
        self.time, self.speed = self.time + 1, float(action[0])
        self.place = float(np.clip(self.place + 2 * self.speed, 0, 5))
        return Step(self.seen(), self.place / 5, truncated=self.time == self.steps)

    def seen(self):
        camera = np.zeros((1, 6, 6), np.uint8)
        camera[0, 2:4, round(self.place)] = 255
        return {"camera": camera, "joint": np.array([self.speed, self.time / 10], np.float32)}

    def named_parts(self):
        return {"velocities": [0], "clock": [1]}

    def describe(self):
        return {"task": "Robot", "steps": self.steps}
