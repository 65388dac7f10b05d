"""Build an autograd graph without the parameters of some modules."""

from collections.abc import Iterator
from contextlib import contextmanager

from torch import nn

__all__ = ["frozen"]


@contextmanager
def frozen(*modules: nn.Module) -> Iterator[None]:
    """Build a graph through modules that excludes their parameters; `no_grad` would cut the path to their inputs.

    The parameters are replaced by detached tensors that share their memory, since the compiler cannot trace
    `requires_grad_`.
    """
    held = [(part, dict(part._parameters)) for module in modules for part in module.modules()]
    for part, parameters in held:
        stand_ins = {name: parameter.detach() for name, parameter in parameters.items() if parameter is not None}
        part._parameters.update(stand_ins)  # type: ignore[arg-type]
    try:
        yield
    finally:
        for part, parameters in held:
            part._parameters.update(parameters)
