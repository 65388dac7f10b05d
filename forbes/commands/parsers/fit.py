"""The first help of `forbes fit`, `validate`, `test` and `predict`, and the options of `fit` alone."""

import argparse

__all__ = ["DESCRIPTION", "help_page", "run_options"]

DESCRIPTION = {
    "fit": "Train a model. It leaves a run folder with the configuration, metrics, checkpoint and figures.",
    "validate": "Run the validation loop of a trained model.",
    "test": "Run the test loop of a trained model; `forbes evaluate` measures it with care.",
    "predict": "Print a line for each sequence of the test split: the bound of a world model in nats, or -log q of "
    "each true state.",
}

_FIT = """\
examples:
  forbes fit --config configs/strokes/forbes.yaml
  forbes fit --config configs/strokes/forbes.yaml --config configs/debug.yaml      # a dry run: later files win
  forbes fit --config configs/strokes/rssm.yaml --seed_everything 1 --run_dir runs/rssm-1
  forbes fit --resume runs/rssm-1 --trainer.max_epochs 20

Every key of a configuration is a flag, without its init_args. Those that people change, as in the first example:
  --model.belief FlowBelief         family of the belief; --model.belief.layers 4 sets an argument of it
  --model.state_dim 8               dimensions of the state; --model.hidden_dim 200 of the recurrent one
  --model.free_nats 0               nats of the KL that cost nothing; --model.kl_warmup 500 updates until it counts
  --model.learning_rate 6e-3        with --model.schedule cosine it ends at 0
  --data.batch_size 50              sequences of an update; --data.length 30 steps of each
  --data.updates_per_epoch 500      between two validations and checkpoints; times --trainer.max_epochs 12
  --data.source Strokes             where sequences come from; --data.source.task TASK of an agent
  --trainer.accelerator auto        or cpu, gpu
  --seed_everything 0               weights, noise, order of the data and an agent's episodes
"""
_OTHERS = """\
example:
  forbes {command} --config RUN/config.yaml --ckpt_path RUN/checkpoints/last.ckpt

RUN is a folder that `forbes fit` has made. Every key of its configuration is a flag: --data.batch_size 10
"""
_MORE = """\
more:
  --print_config                    print the whole configuration, every default included, and leave
  --model.help WorldModel           the arguments of a class; so --data.source.help Strokes
  --help all                        every flag
"""


def help_page(command: str) -> str:
    """Return what a command answers to `--help`: examples and the keys people change."""
    usage = f"usage: forbes {command} --config FILE [--KEY VALUE ...]\n"
    body = f"{_FIT}\n{run_options().format_help()}" if command == "fit" else _OTHERS.format(command=command)
    return "\n".join((usage, f"{DESCRIPTION[command]}\n", body, _MORE))


def run_options() -> argparse.ArgumentParser:
    """Return the parser of the options of `fit` that are not part of a configuration."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False, usage=argparse.SUPPRESS)
    group = parser.add_argument_group(
        "run folder, runs/EXPERIMENT/TIME-SEED/ by default"
    ).add_mutually_exclusive_group()
    group.add_argument("--experiment", metavar="NAME", help="instead of the configuration's name")
    group.add_argument("--run_dir", metavar="DIR", help="the folder itself")
    group.add_argument(
        "--resume", metavar="RUN", help="go on with this run, from its last checkpoint with its config.yaml; flags win"
    )
    parser.add_argument_group("where a loss or gradient is not finite").add_argument(
        "--on-divergence",
        choices=("stop", "lower-rate"),
        default="stop",
        help="stop with exit status 3 (default), or go back one checkpoint and on with half the rates, three times",
    )
    return parser
