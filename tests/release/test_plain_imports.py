"""Without the packages of the extras every module imports, or its error names the extra."""

import subprocess
import sys

import plain_install
import pytest

#: Packages of the extras that no hard dependency installs.
OPTIONAL = ("aiobotocore", "aiohttp", "asammdf", "botocore", "h5py", "ray", "s3fs", "torch", "yarl")


@pytest.mark.slow
def test_every_module_imports_without_extras():
    without = f"import sys; sys.modules.update(dict.fromkeys({OPTIONAL!r}))"
    command = [sys.executable, "-c", f"{without}\n{plain_install.IMPORTS}"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
