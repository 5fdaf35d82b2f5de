"""`python -m palpate` is the `palpate` command."""

import sys

from palpate.app.cli import main

sys.exit(main())
