"""The panel that the benchmark hangs up serves the tests as well."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[2]))
