"""Command line: `python -m flasher`."""

import sys

from flasher.cli.main import main

sys.exit(main())
