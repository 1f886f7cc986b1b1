"""A toolkit in a process of its own, which is asked by name and answers in JSON, a line each."""

import json
import os
import subprocess
from collections.abc import Callable
from typing import Any


def answers() -> Callable[[Any], None]:
    """What takes the answers of this process; whatever else is printed goes to the standard
    error."""
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # whatever a toolkit prints is no answer

    def answer(value: Any) -> None:
        out.write(json.dumps(value) + "\n")
        out.flush()

    return answer


class Process:
    """A script at work that calls :func:`answers`.

    Args:
        python: interpreter, in whose environment the toolkit is.
        arguments: the script and its own.

    Attributes:
        operations: the first answer, the names that it may be asked for; empty where the toolkit is
            not installed.
    """

    def __init__(self, python: str, *arguments: object) -> None:
        self._process = subprocess.Popen(
            [python, *map(str, arguments)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.operations: list[str] = self._answer() or []

    def _answer(self) -> Any:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        return json.loads(line) if line else None

    def ask(self, what: str) -> Any:
        """The answer; None: the process has ended."""
        assert self._process.stdin is not None
        self._process.stdin.write(what + "\n")
        self._process.stdin.flush()
        return self._answer()

    def close(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()
