"""Acting on a belief: λ-returns, actor and critic, and a planner."""
