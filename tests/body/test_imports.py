"""What the service imports of the body must come without the training packages."""

import subprocess
import sys


def test_body_and_report_need_neither_torch_nor_scipy_nor_numba():
    code = (
        "import sys; import caphy.body.bundled, caphy.body.surface, caphy.report.render;"
        "import numpy; caphy.body.bundled.default_body().pose(numpy.zeros((1, 55, 3)));"
        "print([name for name in ('torch', 'scipy', 'numba', 'embreex', 'anny') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
