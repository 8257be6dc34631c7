"""``python -m caphy`` is the ``caphy`` command."""

from __future__ import annotations

import sys

from caphy.cli import main

if __name__ == "__main__":
    sys.exit(main())
