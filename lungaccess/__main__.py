"""The command line as `python -m lungaccess`, where the command itself is not on the path."""

from __future__ import annotations

import sys

from lungaccess.cli.app import main

if __name__ == "__main__":
    sys.exit(main())
