"""Run folders without a model: a configuration and metrics, as a training of hours leaves them."""

import json

__all__ = ["write_agent", "write_run"]

CONFIG = """\
model:
  class_path: forbes.{kind}
  init_args:
    belief: {{class_path: forbes.{belief}}}
    {settings}
data:
  class_path: forbes.SequenceDataModule
  init_args:
    seed: {seed}
    source: {{class_path: forbes.{source}, init_args: {options}}}
"""


def write_run(folder, kind, belief, source, options, lines, seed=0, **settings):
    """Write a run folder with these lines of metrics."""
    folder.mkdir(parents=True)
    written = "\n    ".join(f"{name}: {value}" for name, value in settings.items())
    (folder / "config.yaml").write_text(
        CONFIG.format(kind=kind, belief=belief, source=source, options=json.dumps(options), seed=seed, settings=written)
    )
    (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return str(folder)


def write_agent(
    folder, task, returns, belief="FlowBelief", trajectories=4, layers=2, kind="ImaginationActorCritic", seed=0, **more
):
    """Write the run of an agent with these returns by env steps."""
    lines = [
        {"update": step, "epoch": step, "env_steps": float(step), "return/acting": float(value)}
        for step, value in dict(returns).items()
    ]
    settings = {"mlp_layers": layers} | ({} if kind == "PlanningAgent" else {"trajectories": trajectories})
    return write_run(folder, kind, belief, "Experience", {"task": task} | more, lines, seed, **settings)
