"""Signatures of constructors that pass `**kwargs` on to their base classes."""

import inspect
from inspect import Parameter

__all__ = ["full_signature"]


def full_signature(kind: type) -> inspect.Signature:
    """Return the signature of a class with all arguments, for `help`, `inspect.signature` and notebooks.

    The arguments that `**kwargs` passes on to a base class follow those of the class itself, as keyword-only ones.
    """
    merged: dict[str, Parameter] = {}
    for base in (base for base in kind.__mro__ if "__init__" in vars(base)):
        _, *parameters = inspect.signature(vars(base)["__init__"]).parameters.values()  # without self
        named = [parameter for parameter in parameters if parameter.kind is not Parameter.VAR_KEYWORD]
        new = [parameter for parameter in named if parameter.name not in merged]
        merged |= {p.name: p.replace(kind=Parameter.KEYWORD_ONLY if merged else p.kind) for p in new}
        if len(named) == len(parameters):
            break
    return inspect.Signature([*merged.values()])
