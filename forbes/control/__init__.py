"""Acting on a belief: an agent in an episode, its policy, imagination and losses (algorithm 1), and a planner."""
