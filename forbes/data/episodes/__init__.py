"""Episodes: how they are played, stored and replayed."""
