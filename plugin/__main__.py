"""`python -m palpate` is the `palpate` command."""

import sys

from .cli import main

sys.exit(main())
