"""Run the command line as `python -m forbes`."""

import sys

from forbes.commands.cli import main

if __name__ == "__main__":
    sys.exit(main())
