"""Data: one DataModule, several sources of sequences."""
