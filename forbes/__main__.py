"""Run the command line as `python -m forbes`."""

import sys

from forbes.child import exit_with_parent
from forbes.commands.cli import main

if __name__ == "__main__":
    exit_with_parent()
    sys.exit(main())
