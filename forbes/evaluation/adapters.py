"""Load models that were trained elsewhere by their adapters: `--model my_adapter:Model checkpoint=a.pt`."""

import hashlib
import importlib
import inspect
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
import yaml
from torch import nn

from forbes.data import SequenceData
from forbes.errors import ForbesError
from forbes.evaluation.adapter_checks import check_model
from forbes.evaluation.runs import TrainedRun, load_runs, require_distinct
from forbes.models import BeliefModel
from forbes.reading import shortened

__all__ = ["adapter_folder", "load_adapter", "load_all"]


def load_all(
    paths: Sequence[str],
    models: Sequence[Sequence[str]],
    data: str | None,
    device: str = "cpu",
    needs: Sequence[str] = (),
) -> list[TrainedRun]:
    """Load runs, and models that were trained elsewhere.

    Args:
        paths: run folders.
        models: for each model the words of `--model`: MODULE:CLASS and arguments of its constructor, KEY=VALUE.
        data: configuration or run folder with the data of the models; None for those of the first run.
        device: device of all models.
        needs: methods of the likelihood that the command needs, of `sample` and `mean`; an adapter may have none.

    Raises:
        ForbesError: if there is nothing to load, something is named twice, a model cannot be loaded, or it fails a
            check.
    """
    if not models:
        if data is not None:
            raise ForbesError(f"--data {data}: is for --model; a run has data of its own. Leave it out")
    elif data is None and not paths:
        raise ForbesError("--model: on which data? Name a run first, or a configuration: --data strokes/forbes")
    require_distinct([*paths, *(" ".join(words) for words in models)])
    runs = load_runs(paths, device)
    if models:
        source = runs[0].data if data is None else _data(data)
        runs += [load_adapter(words, source, device, needs) for words in models]
    return runs


def _data(where: str) -> SequenceData:
    from forbes.runs.modules import build_data  # imports Lightning

    return build_data(where)


def load_adapter(
    words: Sequence[str], data: SequenceData, device: str = "cpu", needs: Sequence[str] = ()
) -> TrainedRun:
    """Load and check one model: its module, from the current folder or as installed, its class and its arguments."""
    name = shortened(" ".join(words), 120)
    where = f"--model {name}"
    kind = _class(words[0], where)
    arguments = _arguments(words[1:], kind, where)
    model = _run(f"{where}: constructing it", lambda: kind(**arguments))
    if next(model.parameters(), None) is None:
        raise ForbesError(f"{where}: has no parameters. Assign the network to an attribute of the adapter in __init__")
    model = model.eval().to(device)
    model.requires_grad_(False)
    _run(f"{where}", lambda: check_model(model, data, where, needs))
    section = {"class_path": words[0], "init_args": arguments}
    return TrainedRun(
        " ".join(words), model, data, _sha256(model), {"model": section, "data": {"source": str(data.source)}}
    )


def adapter_folder(words: Sequence[str], output: str | None) -> Path:
    """Return the folder of the results: a name made of the words, in `output` or in the current folder."""
    name = re.sub(r"[^\w.=-]+", "-", " ".join(words)).strip(".-")
    return Path(output or ".") / re.sub(r"\.ckpt$", "-ckpt", name)  # a path that ends in .ckpt is a checkpoint


def _class(path: str, where: str) -> type[BeliefModel]:
    module_name, colon, name = path.partition(":")
    if not (module_name and colon and name):
        raise ForbesError(f"{where}: expected MODULE:CLASS, e.g. my_adapter:Model of my_adapter.py in this folder")
    if "" not in sys.path:
        sys.path.append("")
    module = _run(f"{where}: importing {module_name}", lambda: importlib.import_module(module_name))
    kind = getattr(module, name, None)
    if kind is None:
        defined = [
            name for name, value in vars(module).items() if isinstance(value, type) and value.__module__ == module_name
        ]
        raise ForbesError(f"{where}: {module_name} has no {name}, its classes are {', '.join(defined) or 'none'}")
    if not (isinstance(kind, type) and issubclass(kind, BeliefModel)):
        raise ForbesError(
            f"{where}: {name} is no subclass of forbes.ModelAdapter. Derive it: class {name}(forbes.ModelAdapter)"
        )
    if missing := sorted(getattr(kind, "__abstractmethods__", ())):
        raise ForbesError(
            f"{where}: {name} has no {' and no '.join(missing)}. Implement what forbes.ModelAdapter describes"
        )
    return kind


def _arguments(words: Sequence[str], kind: type[nn.Module], where: str) -> dict[str, Any]:
    """Return the arguments of the constructor: values are YAML, so that 8 is a number and true a truth value."""
    expected = inspect.signature(kind).parameters
    given: dict[str, Any] = {}
    for word in words:
        key, equals, value = word.partition("=")
        if not equals:
            raise ForbesError(f"{where}: {word} is not KEY=VALUE. Runs come before --model")
        if key not in expected and not any(each.kind is each.VAR_KEYWORD for each in expected.values()):
            raise ForbesError(f"{where}: there is no argument {key}, expected some of {', '.join(expected) or 'none'}")
        try:
            given[key] = yaml.safe_load(value)
        except yaml.YAMLError as error:
            raise ForbesError(f"{where}: the value of {key} is not one of YAML. Put it in quotes") from error
    for key, each in expected.items():
        if (
            each.default is each.empty
            and each.kind in (each.POSITIONAL_OR_KEYWORD, each.KEYWORD_ONLY)
            and key not in given
        ):
            raise ForbesError(
                f"{where}: the argument {key} is missing. Give it: --model {where.split()[1]} {key}=VALUE"
            )
    return given


def _run(what: str, function: Callable[[], Any]) -> Any:
    """Run foreign code; whatever it raises is one sentence."""
    try:
        return function()
    except ForbesError:
        raise
    except Exception as error:
        cause = f"{type(error).__name__}: {shortened(str(error), 160)}"
        raise ForbesError(f"{what} fails ({cause}). Change the adapter; --debug shows where") from error


def _sha256(model: BeliefModel) -> str:
    """Hash the weights and the module of an adapter: what its scores depend on."""
    digest = hashlib.sha256(Path(inspect.getfile(type(model))).read_bytes())
    for name, values in model.state_dict().items():
        digest.update(name.encode())
        digest.update(values.cpu().reshape(-1).contiguous().view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()
