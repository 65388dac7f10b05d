"""`forbes fit --on-divergence lower-rate`: go back to the last checkpoint and continue at half the learning rate."""

import sys

from forbes.runs.checkpoint import read_checkpoint
from forbes.runs.folder import RunFolder, read_config
from forbes.runs.metrics_log import JsonLinesLogger
from forbes.training.divergence import DivergedError

__all__ = ["MOST", "LowerRateError", "at_half_the_rate"]

MOST = 3
"""Number of times that a command lowers the rate before it stops."""


class LowerRateError(DivergedError):
    """A training diverged and shall continue at a lower rate.

    Args:
        error: divergence of the training.
        run: run folder of the training.
    """

    def __init__(self, error: DivergedError, run: RunFolder) -> None:
        super().__init__(str(error), error.update)
        self.run = run


def at_half_the_rate(error: LowerRateError) -> list[str]:
    """Return the arguments of the `forbes fit` that continues, and log the new rates to the metrics of the run.

    All rates of the module (arguments named `..._rate`) are halved. Without a checkpoint the training starts over. The
    step of the line in metrics.jsonl is the update that the training goes back to, `divergence/update` is the update
    that was not finite (counted from 1), and `divergence/NAME` is the new value of each rate.
    """
    run = error.run
    before = read_config(run.config)["model"]["init_args"]
    rates = {name: value / 2 for name, value in before.items() if name.endswith("_rate")}
    begin, update = ["--config", str(run.config), "--run_dir", str(run)], 0
    if run.checkpoint.exists():
        begin, update = ["--resume", str(run)], read_checkpoint(run.checkpoint)["global_step"]
    named = {f"divergence/{name}": rate for name, rate in rates.items()}
    JsonLinesLogger(run.metrics).log_metrics({"divergence/update": error.update, **named}, step=update - 1)
    new_rates = ", ".join(f"{name} {rate:g}" for name, rate in rates.items())
    print(f"forbes: {error}\nforbes: continues from update {update} with {new_rates}", file=sys.stderr, flush=True)
    flags = [part for name, rate in rates.items() for part in (f"--model.{name}", str(rate))]
    return [*begin, *flags, "--on-divergence", "lower-rate"]
