"""PlaNet as a LightningModule: a world model, and an agent that plans its next action at each step."""

from typing import Any

from forbes.control.agent import ActionSelector, follow_plan, noisy
from forbes.control.planning import CrossEntropy
from forbes.errors import ForbesError, require_at_least
from forbes.training.acting import WorldModelAgent

__all__ = ["PlanningAgent"]


class PlanningAgent(WorldModelAgent):
    """Learns a world model and plans in it, on beliefs of any family (PlaNet, Hafner et al., 2019, arXiv 1811.04551).

    Args:
        horizon: steps of a plan, H.
        iterations: iterations of the search.
        candidates: action sequences per iteration, J.
        best: number of elites, M, from which the next proposal is computed.
        **acting: arguments of `WorldModelAgent` and `WorldModel`.

    Raises:
        ForbesError: when an argument is below 1, `best` above `candidates`, or actions are discrete.

    Example:
        >>> data = forbes.SequenceDataModule(forbes.Experience("mountain_hike"), length=30, batch_size=20)
        >>> agent = forbes.PlanningAgent.for_data(data, candidates=100, best=10)
        >>> agent.model.action_dim, agent.discrete
        (2, False)
        >>> data.source.close()
    """

    def __init__(
        self, horizon: int = 12, iterations: int = 10, candidates: int = 1000, best: int = 100, **acting: Any
    ) -> None:
        super().__init__(**acting)
        name = type(self).__name__
        require_at_least(1, name, horizon=horizon, iterations=iterations, best=best)
        require_at_least(best, name, candidates=candidates)
        if self.discrete:
            raise ForbesError(f"{name}: the data's actions are discrete, expected vectors. Use ImaginationActorCritic")
        self.search = CrossEntropy(horizon, iterations, candidates, best)

    def action_selector(self, exploring: bool) -> ActionSelector:
        """See `WorldModelAgent.action_selector`: the plan, with noise on it or not."""
        plan = follow_plan(self.model, self.reward, self.search)
        return noisy(plan, self.exploration) if exploring else plan
