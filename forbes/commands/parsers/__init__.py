"""The arguments of every command, one file each. Nothing heavy is imported, so that `--help` is fast."""
