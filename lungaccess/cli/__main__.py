"""What `python -m lungaccess` runs."""

import sys

from lungaccess.cli.app import main

sys.exit(main())
