"""Agents that train in a second on a toy, through the command line."""

from forbes.commands.cli import main

__all__ = ["fit", "forbes", "write_config", "write_image_config"]

CONFIG = """\
model:
  class_path: {agent}
  init_args:
    belief: {{class_path: {belief}}}
    encoder: {{class_path: MLPEncoder, init_args: {{width: 8, layers: 1}}}}
    decoder: {{class_path: MLPDecoder, init_args: {{width: 8, layers: 1}}}}
    likelihood: {{class_path: VectorNormal}}
    state_dim: 2
    hidden_dim: 6
    mlp_dim: 8
    mlp_layers: 1
    control_dim: 8
    {more}
data:
  class_path: SequenceDataModule
  init_args:
    source: {{class_path: Experience, init_args: {{task: Parrot, options: {{steps: 8}}}}}}
    batch_size: 3
    length: 5
    updates_per_epoch: 4
trainer:
  max_epochs: 3
  limit_val_batches: 0
  log_every_n_steps: 1
  callbacks:
    - {{class_path: Collect, init_args: {{seed_episodes: 2, evaluate_every: 2, evaluation_episodes: 2}}}}
"""
AGENTS = {
    "forbes": ("ImaginationActorCritic", "FlowBelief", "horizon: 3"),
    "dreamer": ("ImaginationActorCritic", "GaussianBelief", "{horizon: 3, trajectories: 1}"),
    "planet": ("PlanningAgent", "GaussianBelief", "horizon: 2"),
}


def write_config(folder, kind="forbes"):
    agent, belief, more = AGENTS[kind]
    path = folder / f"{kind}.yaml"
    text = CONFIG.format(agent=agent, belief=belief, more=more.strip("{}").replace(", ", "\n    "))
    if kind == "planet":
        text = text.replace("    horizon: 2", "    horizon: 2\n    candidates: 20\n    best: 5\n    iterations: 2")
    path.write_text(text)
    return path


def write_image_config(folder, *callbacks):
    """Configure an agent that sees images, with further callbacks, each a YAML of one line."""
    text = (
        write_config(folder)
        .read_text()
        .replace("Parrot, options: {steps: 8}", "Slide")
        .replace("VectorNormal", "Normal")
    )
    path = folder / "images.yaml"
    path.write_text(text + "".join(f"    - {callback}\n" for callback in callbacks))
    return path


def forbes(*arguments):
    """Run a command that knows the toy environments."""
    return main(["--allow-module", "toy_environments", *map(str, arguments)])


def fit(*arguments):
    return forbes("fit", *arguments)
