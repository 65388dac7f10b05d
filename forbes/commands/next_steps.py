"""What `forbes fit` prints at its end: where the run is, and the commands that one wants next."""

import shlex

from lightning import LightningModule

from forbes.runs.folder import RunFolder
from forbes.training.acting import WorldModelAgent
from forbes.training.known_belief import KnownBelief
from forbes.training.world_model import WorldModel

__all__ = ["next_steps"]


def next_steps(run: RunFolder, module: LightningModule) -> str:
    """Return the lines about a run that has ended, with commands that work for its kind of model."""
    name = shlex.quote(str(run))
    commands = [f"forbes runs show {name}"]
    if isinstance(module, WorldModelAgent):
        commands += [f"forbes evaluate {name}", f"forbes rollout {name} --video agent.gif --imagine 15"]
    elif isinstance(module, WorldModel):
        commands += [f"forbes evaluate {name}", f"forbes figures elbo --runs {name}"]
    elif isinstance(module, KnownBelief):
        commands += [f"forbes beliefs {name}"]
    return "\n".join([f"trained: {name}. Next:", *(f"  {command}" for command in commands)])
