"""Episodes recorded by other software: a reader per format, and the import to an episode store."""
