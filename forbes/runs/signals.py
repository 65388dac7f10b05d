"""The signals that stop a training, and the exit statuses that follow from them."""

import signal

__all__ = ["ANNOUNCED", "OF_A_USER", "STOPPED"]

OF_A_USER = (signal.SIGINT, signal.SIGTERM)
ANNOUNCED = (signal.SIGUSR1, signal.SIGUSR2)
"""Signals of a cluster before it takes the machine away."""
STOPPED = frozenset(status for number in (*OF_A_USER, *ANNOUNCED) for status in (128 + number, -number))
"""Exit statuses of a training that a signal ended; negative ones if it came before the training began."""
