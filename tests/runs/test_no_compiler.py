from __future__ import annotations

import subprocess
import sys


def test_looking_at_a_log_loads_no_compiler_and_no_network() -> None:
    code = (
        "import sys, pdhef_logtool.cli.inspecting, pdhef_logtool.runs.config, pdhef_logtool.runs.inspection\n"
        "print(sorted({'numba', 'torch', 'scipy', 'rerun', 'polars', 'pyarrow'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
