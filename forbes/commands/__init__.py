"""The commands, one file each. Their arguments are in `parsers/`, which does not import torch, so `--help` is fast."""
