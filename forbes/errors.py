"""The error a user can mend: one sentence that says what, where and what to do."""

__all__ = ["ForbesError"]


class ForbesError(Exception):
    """Bad input or a bad environment.

    The message is one clear sentence: where, what, what was expected, what to do. The command line prints it
    as ``forbes: <message>`` and exits with `exit_status`; ``--debug`` shows the traceback.
    """

    exit_status = 2
