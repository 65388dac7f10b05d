"""A package that registers environments of Gymnasium when it is imported, as MiniGrid and POPGym do."""

import gymnasium
import numpy as np
from gymnasium import spaces


class MissionSpace(spaces.Space[str]):
    """Text in a class of the package's own, which Gymnasium cannot flatten."""

    def __init__(self):
        super().__init__(dtype=str)

    def sample(self, mask=None, probability=None):
        return "get to the goal"

    def contains(self, x):
        return isinstance(x, str)


class Given(gymnasium.Env):
    """Shows a value of its space, says what it was told to do, and has no `render_mode`."""

    action_space = spaces.Discrete(3)

    def __init__(self, space, value, action_space=None):
        self.observation_space, self.value = space, value
        self.action_space = spaces.Discrete(3) if action_space is None else action_space

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.value, {}

    def step(self, action):
        assert self.action_space.contains(action), action
        self.taken = action
        return self.value, 0.0, False, False, {}


class Rooms(Given):
    """Observations are those of MiniGrid: codes of the cells ahead, a direction, and a mission in words."""

    def __init__(self):
        cells = spaces.Box(0, 255, (7, 7, 3), np.uint8)
        space = spaces.Dict(direction=spaces.Discrete(4), image=cells, mission=MissionSpace())
        value = {"direction": 2, "image": np.full((7, 7, 3), 51, np.uint8), "mission": "get to the goal"}
        super().__init__(space, value)


gymnasium.register("Toy-Rooms-v0", entry_point="toy_gymnasium:Rooms", max_episode_steps=4)


class Levers(gymnasium.Env):
    """Several choices at a time: each shows what was chosen, and pays if it is another than before."""

    def __init__(self, action_space):
        self.action_space = action_space
        self.observation_space = spaces.Box(-9, 9, action_space.shape)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.last = np.zeros(self.action_space.shape, np.float32)
        return self.last, {}

    def step(self, action):
        assert self.action_space.contains(action), action
        before, self.last = self.last, np.asarray(action, np.float32)
        return self.last, float((self.last != before).mean()), False, False, {}


for name, space in {"Levers": spaces.MultiDiscrete([3, 2]), "Buttons": spaces.MultiBinary(3)}.items():
    gymnasium.register(
        f"Toy-{name}-v0", entry_point="toy_gymnasium:Levers", max_episode_steps=8, kwargs={"action_space": space}
    )
