"""Every reader on damaged copies of its file: a clear error, or data; no crash, no hang."""

import json
import os
import subprocess
import sys

import damage
import pytest

from torchpcct.formats.damage import yaml_values

COPIES = 60
MINUTES = float(os.environ.get("TORCHPCCT_FUZZ_MINUTES", "10"))
"""For all readers together, in the slow test."""
SEED = int(os.environ.get("TORCHPCCT_FUZZ_SEED", "0"))


def _check(reader, found):
    assert set(found) <= {"same", "other", "refused"}, found
    # What a checksum seals is what was written, or refused.
    assert reader not in damage.SEALED or "other" not in found


@pytest.mark.parametrize("reader", damage.READERS)
def test_damaged_files(reader, tmp_path):
    """A copy in five is cut off; what a checksum seals is refused when anything in it differs."""
    found = damage.outcomes(reader, tmp_path, COPIES)
    _check(reader, found)
    assert found["refused"] >= COPIES * (0.75 if reader in damage.SEALED else 0.17)


@pytest.mark.slow
@pytest.mark.parametrize("reader", damage.READERS)
def test_fuzzed_readers(reader, tmp_path):
    """Other copies, as many as the time allows, in a process of its own: a crash of a C library or
    a hang is a failure of this test, not of all. ``TORCHPCCT_FUZZ_MINUTES`` and
    ``TORCHPCCT_FUZZ_SEED`` change it."""
    limits = (10**6, 60 * MINUTES / len(damage.READERS), SEED + 1)
    command = [sys.executable, damage.__file__, reader, str(tmp_path / "files"), *map(str, limits)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=3600, check=False)
    assert done.returncode == 0, f"exit {done.returncode}: {done.stderr[-2000:]}"
    found = json.loads(done.stdout.splitlines()[-1])
    _check(reader, found)
    assert found["refused"] > 0
    print(f"{reader}: {found}")


@pytest.mark.parametrize(
    ("text", "base"), [("a: 1\nsod: 0300", 8), ("a: 1\nsod: -0_17", 8), ("a: 1\nsod: 5:00", 60)]
)
def test_numbers_to_another_base_are_refused(text, base):
    """``0300`` is 192 in YAML, ``5:00`` is 300."""
    with pytest.raises(ValueError, match=f"in line 2 is a number to the base of {base}"):
        yaml_values(text)


def test_numbers_as_they_look():
    text = "{a: 300, b: 0, c: 07, d: 0.5, e: -1e3, f: '5:00', g: 1_000, h: 0x1f, i: 10:75 h}"
    assert list(yaml_values(text).values()) == [300, 0, 7, 0.5, "-1e3", "5:00", 1000, 31, "10:75 h"]


def test_a_name_twice_in_a_mapping_is_refused():
    for text in ("a: 1\nb: 2\na: 3\n", "x: [{a: 1, b: 2,\n\n a: 1}]"):
        with pytest.raises(ValueError, match="it has a twice, in line 1 and line 3: leave one out"):
            yaml_values(text)
    sound = "a: &a {n: 1, m: 2}\nb: {<<: *a, n: 3}\nc: [*a, *a]\n"
    assert yaml_values(sound)["b"] == {"n": 3, "m": 2}
    assert yaml_values("") is None
