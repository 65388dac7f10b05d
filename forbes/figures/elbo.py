"""Figure 5 of the paper: the ELBO against updates."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

from matplotlib.figure import Figure

from forbes.evaluation.references import reference_means
from forbes.evaluation.runs import recorded_runs
from forbes.figures.families import group, require_same_data
from forbes.figures.style import COLUMN, Method, draw_range, draw_references, paper_style, show_settled

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["FamilyCurves", "draw_elbo", "elbo_against_updates"]


class FamilyCurves(NamedTuple):
    """The training curves of a family."""

    label: str
    style: Method
    bound: str
    """Name of the training bound, e.g. `elbo[S=1]`."""
    curves: "Sequence[pd.Series]"
    """The bound on the validation split against updates, one curve per run."""
    tests: Sequence[float]
    """Test ELBO of each evaluated run, if the ELBO is the training bound."""


def draw_elbo(runs: Sequence[str]) -> dict[str, Figure]:
    """Draw `elbo_against_updates` of the families that the runs form, with references on the validation split.

    Raises:
        ForbesError: if the runs are of different data, or one has no validation yet.
    """
    trained = recorded_runs(runs)
    require_same_data(trained)
    data = trained[0].data
    count = min(data.validation_sequences, data.source.size("validation"))
    means = reference_means(data, trained[0].model.likelihood, "validation", count)
    families = [
        FamilyCurves(family.label, family.style, family.model.bound_name, family.curves(), family.test_elbos())
        for family in group(trained)
    ]
    return {"elbo": elbo_against_updates(families, means)}


def elbo_against_updates(families: Sequence[FamilyCurves], references: Mapping[str, float]) -> Figure:
    """Draw Figure 5: validation ELBO against updates, mean and range over runs; a diamond is the final test ELBO.

    A family trained with another bound is drawn with that bound, and the legend then names all bounds. Dotted lines are
    the `references` on the validation split, by name.
    """
    import pandas as pd

    bounds = {family.bound for family in families}
    with paper_style():
        figure = Figure((COLUMN, 2.3), layout="constrained")
        axes = figure.subplots()
        shown = [curve for family in families for curve in family.curves]
        for family in families:
            table = pd.concat(family.curves, axis=1).dropna()  # updates common to all runs
            draw_range(axes, table, family.style, family.label + (f", {family.bound}" if len(bounds) > 1 else ""))
            if family.tests:
                end = pd.Series([sum(family.tests) / len(family.tests)], [table.index.max()])
                (diamond,) = axes.plot(end, "D", color=family.style.colour, markersize=5, zorder=3)
                diamond.set(markeredgecolor="white", clip_on=False)
                shown.append(end)
        if any(family.tests for family in families):
            axes.plot([], [], "D", color="none", markeredgecolor="black", markersize=4, label="final test")
        show_settled(axes, shown)
        draw_references(axes, references)
        if len(bounds) == 1:
            title = bounds.pop().replace("elbo", "ELBO")
            axes.legend(loc="lower right")
        else:
            title = "bound"
            figure.legend(loc="outside upper center")  # the names of the bounds would cover the curves
        axes.set(xlabel="updates", ylabel=f"{title}\nvalidation, nats per sequence")
    return figure
