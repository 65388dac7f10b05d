"""The arguments of every command, one file each: nothing heavy is imported, so that help comes at once."""
