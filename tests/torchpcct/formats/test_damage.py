"""Every reader on 300 damaged copies of its file: a clear error, or data; no crash, no hang."""

from __future__ import annotations

import json
import subprocess
import sys

import damage
import pytest


@pytest.mark.slow
@pytest.mark.parametrize("reader", damage.READERS)
def test_damaged_files(reader, tmp_path):
    """In a process of its own: a crash of a C library or a hang is a failure of this test, not of all."""
    command = [sys.executable, damage.__file__, reader, str(tmp_path / "files"), "300"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=3600, check=False)
    assert done.returncode == 0, f"exit {done.returncode}: {done.stderr[-2000:]}"
    found = json.loads(done.stdout.splitlines()[-1])
    assert sum(found.values()) == 300
    assert set(found) <= {"same", "other", "refused"}, found
    # A copy in five is cut off.
    assert found["refused"] >= (250 if reader in damage.SEALED else 50)
    if reader in damage.SEALED:
        assert "other" not in found
