"""Without the packages of the extras every module imports, or its error names the extra."""

from __future__ import annotations

import subprocess
import sys

import plain_install
import pytest

#: Packages of the extras that no hard dependency installs.
OPTIONAL = ("aiobotocore", "aiohttp", "asammdf", "botocore", "h5py", "ray", "s3fs", "torch", "yarl")


@pytest.mark.slow
@pytest.mark.parametrize(("extras", "code"), [((), 0), (("train",), 1)])
def test_every_module_imports_without_extras(extras: tuple[str, ...], code: int) -> None:
    without = f"import sys; sys.modules.update(dict.fromkeys({OPTIONAL!r}))"
    command = [sys.executable, "-c", f"{without}\n{plain_install.IMPORTS}", *extras]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == code, done.stdout + done.stderr
    assert ("pdhef_logtool.residual_model.network: " in done.stdout) is bool(code), "an extra that is installed"
