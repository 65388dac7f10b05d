"""Run folders: configuration, checkpoints, metrics and provenance, and how they are loaded again."""
