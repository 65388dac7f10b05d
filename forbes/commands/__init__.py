"""Commands: one file for each; `parsers/` has their arguments, free of torch, so that `--help` is fast."""
