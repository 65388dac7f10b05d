"""What a constructor takes where it hands `**kwargs` on to those of its base classes."""

import inspect
from inspect import Parameter

__all__ = ["full_signature"]


def full_signature(kind: type) -> inspect.Signature:
    """Return the signature of a class with every argument in it, for `help`, `inspect.signature` and notebooks.

    The arguments that `**kwargs` hands on to a base class follow those of the class itself, by keyword only.
    """
    found: dict[str, Parameter] = {}
    for base in (base for base in kind.__mro__ if "__init__" in vars(base)):
        _, *own = inspect.signature(vars(base)["__init__"]).parameters.values()  # without self
        named = [parameter for parameter in own if parameter.kind is not Parameter.VAR_KEYWORD]
        new = [parameter for parameter in named if parameter.name not in found]
        found |= {one.name: one.replace(kind=Parameter.KEYWORD_ONLY if found else one.kind) for one in new}
        if len(named) == len(own):
            break
    return inspect.Signature([*found.values()])
