"""What `forbes fit --on-divergence lower-rate` does: go back one checkpoint, and on from there at half the rate."""

import sys

from forbes.runs.checkpoint import read_checkpoint
from forbes.runs.folder import RunFolder, read_config
from forbes.runs.metrics_log import JsonLinesLogger
from forbes.training.divergence import DivergedError

__all__ = ["MOST", "LowerRateError", "at_half_the_rate"]

MOST = 3
"""Times that a command lowers the rate, before it stops."""


class LowerRateError(DivergedError):
    """A training has diverged that is to go on at a lower rate.

    Args:
        error: why.
        run: of the training.
    """

    def __init__(self, error: DivergedError, run: RunFolder) -> None:
        super().__init__(str(error), error.update)
        self.run = run


def at_half_the_rate(error: LowerRateError) -> list[str]:
    """Return the arguments of the `forbes fit` that goes on, and note the new rates in the metrics of the run.

    All rates of the module, its arguments `..._rate`, are halved. Where there is no checkpoint yet, the training begins
    again. The line in metrics.jsonl has the update that the training goes back to, `divergence/update`, the update that
    was not finite as errors count them, from 1, and each rate as `divergence/NAME`.
    """
    run = error.run
    before = read_config(run.config)["model"]["init_args"]
    rates = {name: value / 2 for name, value in before.items() if name.endswith("_rate")}
    begin, update = ["--config", str(run.config), "--run_dir", str(run)], 0
    if run.checkpoint.exists():
        begin, update = ["--resume", str(run)], read_checkpoint(run.checkpoint)["global_step"]
    named = {f"divergence/{name}": rate for name, rate in rates.items()}
    JsonLinesLogger(run.metrics).log_metrics({"divergence/update": error.update, **named}, step=update - 1)
    told = ", ".join(f"{name} {rate:g}" for name, rate in rates.items())
    print(f"forbes: {error}\nforbes: goes on from update {update} with {told}", file=sys.stderr, flush=True)
    flags = [part for name, rate in rates.items() for part in (f"--model.{name}", str(rate))]
    return [*begin, *flags, "--on-divergence", "lower-rate"]
