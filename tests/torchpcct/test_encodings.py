"""Terminals that are no UTF-8: containers, cron, Windows code pages. What they lack is replaced,
nothing ends."""

import os
import subprocess
import sys

import pytest


@pytest.mark.parametrize("encoding", ["ascii", "cp1252", "ascii:strict"])
@pytest.mark.parametrize("stream", ["stdout", "stderr"])
def test_what_the_terminal_cannot_show_is_replaced(encoding, stream):
    code = (
        "import sys; from torchpcct.files import speak_any_encoding; speak_any_encoding(); "
        f"print('done: \\u27e8 ± µ \\u2026', file=sys.{stream})"
    )
    environment = os.environ | {"PYTHONIOENCODING": encoding}
    run = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, check=True
    )
    assert getattr(run, stream).startswith(b"done: ?")


@pytest.mark.parametrize(
    "words",
    [
        ["--help"],
        ["doctor", "--help"],
        ["info", "no such file"],
        ["train", "--help"],
        ["study", "--help"],
    ],
)
def test_commands_speak_ascii(words):
    environment = os.environ | {"PYTHONIOENCODING": "ascii", "LANG": "C"}
    run = subprocess.run(
        [sys.executable, "-m", "recon.cli", *words], env=environment, capture_output=True
    )
    said = run.stdout + run.stderr
    assert run.returncode in (0, 2)
    assert b"codec" not in said
    assert b"Traceback" not in said
