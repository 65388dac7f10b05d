"""The short help of `forbes fit`, `validate`, `test` and `predict`, and the options of `fit` alone."""

import argparse

__all__ = ["DESCRIPTION", "help_page", "run_options"]

DESCRIPTION = {
    "fit": "Train a model. Writes a run folder with the configuration, metrics, checkpoint and figures.",
    "validate": "Run the validation loop of a trained model.",
    "test": "Run the test loop of a trained model. For careful scores use `forbes evaluate`.",
    "predict": "Print one line per sequence of the test split: the bound of a world model in nats, or -log q of each "
    "true state.",
}

_FIT = """\
examples:
  forbes fit strokes/forbes
  forbes fit strokes/forbes debug      # a dry run: later configurations override
  forbes fit strokes/rssm --seed_everything 1 --run_dir runs/rssm-1
  forbes fit --resume runs/rssm-1 --trainer.max_epochs 20

CONFIG is a name that `forbes configs` lists, or the path of a file. Every key of it is a flag, without init_args. The
most common ones, with the values of the first example:
  --model.belief FlowBelief         belief family; --model.belief.layers 4 sets one of its arguments
  --model.state_dim 8               dimension of the stochastic state; --model.hidden_dim 200 of the recurrent state
  --model.free_nats 0               nats of the KL without cost; --model.kl_warmup 500 updates until its full weight
  --model.learning_rate 6e-3        learning rate; with --model.schedule cosine it decays to 0
  --data.batch_size 50              sequences per batch; --data.length 30 steps per sequence
  --data.updates_per_epoch 500      updates between validations and checkpoints; --trainer.max_epochs 10 epochs
  --data.source Strokes             source of the sequences; --data.source.task TASK for an agent
  --trainer.accelerator auto        auto, cpu or gpu
  --seed_everything 0               random seed for weights, noise, order of the data and an agent's episodes
"""
_OTHERS = """\
example:
  forbes {command} RUN/config.yaml --ckpt_path RUN/checkpoints/last.ckpt

RUN is a run folder written by `forbes fit`. Every key of its configuration is a flag: --data.batch_size 10
"""
_MORE = """\
more:
  --print_config                    print the complete configuration, with all defaults, and exit
  --model.help WorldModel           show the arguments of a class; also --data.source.help Strokes
  --help all                        show every flag
"""


def help_page(command: str) -> str:
    """Return the short help page of a command, with examples and the most common keys."""
    usage = f"usage: forbes {command} CONFIG [CONFIG ...] [--KEY VALUE ...]\n"
    body = f"{_FIT}\n{run_options().format_help()}" if command == "fit" else _OTHERS.format(command=command)
    return "\n".join((usage, f"{DESCRIPTION[command]}\n", body, _MORE))


def run_options() -> argparse.ArgumentParser:
    """Return the parser of the options of `fit` that are not part of a configuration."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False, usage=argparse.SUPPRESS)
    group = parser.add_argument_group(
        "run folder, runs/EXPERIMENT/TIME-SEED/ by default"
    ).add_mutually_exclusive_group()
    group.add_argument("--experiment", metavar="NAME", help="name to use instead of the configuration's")
    group.add_argument("--run_dir", metavar="DIR", help="path of the run folder")
    group.add_argument(
        "--resume", metavar="RUN", help="resume a run from its last checkpoint and config.yaml; flags override it"
    )
    parser.add_argument_group("if a loss or gradient is not finite").add_argument(
        "--on-divergence",
        choices=("stop", "lower-rate"),
        default="stop",
        help="stop with exit status 3 (default), or go back to the last checkpoint and halve the rates, up to 3 times",
    )
    return parser
