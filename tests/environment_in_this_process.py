"""A stand-in for the process of an environment, which would spend most of a test on its imports."""

from forbes.envs import EnvironmentProcess

__all__ = ["play_here"]


def play_here(patch):
    """Build and step every environment in this process."""

    def start(self):
        self._process = environment = self.make()
        self.observation_shape, self.action_dim = environment.observation_shape, environment.action_dim
        self.discrete, self.action_repeat = environment.discrete, environment.action_repeat
        self._description = environment.describe()

    patch.setattr(EnvironmentProcess, "_start", start)
    patch.setattr(EnvironmentProcess, "_ask", lambda self, method, value: getattr(self._process, method)(value))
    patch.setattr(EnvironmentProcess, "close", lambda self: setattr(self, "_process", None))
