"""Records of a run: CSV tables, TensorBoard events, validation pictures, a progress line."""

from __future__ import annotations

import csv
import io
import logging
import math
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from matplotlib.image import imsave
from tqdm import tqdm

from torchpcct.files import WriteError, atomic_write

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

    from torchpcct.typing import Reals


logger = logging.getLogger(__name__)

DARKEST_HU = -150.0
"""What is black in pictures, HU."""
BRIGHTEST_HU = 450.0
"""What is white in pictures, HU."""
SMALLEST_PICTURE = 256
"""Pictures are enlarged by a whole factor until their shorter side has this many pixels."""


class Table:
    """A CSV file that grows by rows; the first column is the step.

    Numbers are written so that they read back exactly. A row with a new column rewrites the file.

    Args:
        path: file; an existing one is continued.
        after: rows beyond this step, and a last row that was cut short, are dropped from an
            existing file.
    """

    def __init__(self, path: Path, after: int = 0) -> None:
        self.path = path
        self.columns: list[str] = []
        self._rows: list[dict[str, str]] = []
        self._file: TextIO | None = None
        if path.exists():
            text = path.read_text(encoding="utf-8")
            # Without its line end the last row may be cut short anywhere, also within a number.
            rows = list(csv.DictReader(io.StringIO(text[: text.rfind("\n") + 1])))
            self._rows = [
                r
                for r in rows
                if None not in r.values() and r["step"].isdigit() and int(r["step"]) <= after
            ]
            if self._rows:
                self.columns = list(self._rows[0])
                self._rewrite()
            else:
                path.unlink()

    def append(self, step: int, values: Mapping[str, float]) -> None:
        """Add a row, at once visible to other processes."""
        row = {"step": str(step), **{k: _number(v) for k, v in values.items()}}
        fresh = [n for n in row if n not in self.columns]
        self._rows.append(row)
        if fresh:
            self.close()
            self.columns += fresh
            self._rewrite()
            return
        if self._file is None:
            self._file = open(self.path, "a", encoding="utf-8", newline="")  # noqa: SIM115 (stays open)
        try:
            self._writer(self._file).writerow(row)
            self._file.flush()
        except OSError as error:
            raise WriteError(f"cannot write {self.path}: {error.strerror or error}") from error

    def sync(self) -> None:
        """Onto the disk: a checkpoint must not be newer than the rows before it."""
        if self._file is not None:
            os.fsync(self._file.fileno())

    def close(self) -> None:
        """Close the file; another row opens it again."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def _rewrite(self) -> None:
        with atomic_write(self.path) as part, open(part, "w", encoding="utf-8", newline="") as file:
            writer = self._writer(file)
            writer.writeheader()
            writer.writerows(self._rows)

    def _writer(self, file: TextIO) -> csv.DictWriter[str]:
        return csv.DictWriter(file, self.columns, lineterminator="\n")


def _number(value: float) -> str:
    value = float(value)
    return str(int(value)) if value.is_integer() and abs(value) < 2**53 else repr(value)


class Logs:
    """Everything a run writes beside its checkpoints.

    ``log.csv`` has a row per logged step, ``validation.csv`` one per validation, ``pictures/`` the
    sections of every validation, ``tensorboard/`` the same figures as events, if tensorboard is
    installed.

    Args:
        folder: of the run, existing.
        step: completed steps at the start; what an interrupted run wrote beyond them is dropped.
        steps: of the whole run.
        progress: show a progress line on the error stream.
        tensorboard: write events.
        validated: step of the last validation that counts.
    """

    def __init__(
        self,
        folder: Path,
        step: int,
        steps: int,
        progress: bool = True,
        tensorboard: bool = True,
        validated: int = 0,
    ) -> None:
        self.folder = folder
        self.table = Table(folder / "log.csv", step)
        self.validation = Table(folder / "validation.csv", validated)
        self.pictures = folder / "pictures"
        self.pictures.mkdir(exist_ok=True)
        self._writer = _writer(folder / "tensorboard", step + 1) if tensorboard else None
        self._bar = tqdm(
            total=steps,
            initial=step,
            desc="train",
            unit="step",
            disable=not progress,
            dynamic_ncols=True,
            # Over about 20 steps: they differ in their scenes, and some wait for a checkpoint.
            smoothing=0.05,
            # A log file needs no line a second.
            mininterval=0.5 if sys.stderr.isatty() else 10.0,
        )

    def step(self, step: int, values: Mapping[str, float], logged: bool) -> None:
        """A step is done.

        Args:
            step: number of steps done, from 1.
            values: figures of the step; ``loss`` is shown in the progress line.
            logged: give it a row.
        """
        if logged:
            self.table.append(step, values)
            self._events("train", step, values)
        if "loss" in values:
            self._bar.set_postfix_str(f"loss {values['loss']:.4g}", refresh=False)
        self._bar.update(step - self._bar.n)

    def validated(
        self,
        step: int,
        score: float,
        figures: Mapping[str, float],
        pictures: Mapping[str, Reals],
    ) -> None:
        """A validation is done."""
        values = {"score": score, **figures}
        self.validation.append(step, values)
        self._events("validation", step, values)
        for name, image in pictures.items():
            factor = max(1, math.ceil(SMALLEST_PICTURE / min(image.shape)))
            with atomic_write(self.pictures / f"{name}_{step:06d}.png") as part:
                large = image.repeat(factor, 0).repeat(factor, 1)
                imsave(part, large, vmin=DARKEST_HU, vmax=BRIGHTEST_HU, cmap="gray", format="png")
        self.message(f"step {step}: validation score {score:.5g}")

    def message(self, text: str) -> None:
        """A line above the progress line; to the log if there is none."""
        if self._bar.disable:
            logger.info(text)
        else:
            self._bar.write(text, file=self._bar.fp)

    def sync(self) -> None:
        """Rows onto the disk."""
        self.table.sync()
        self.validation.sync()

    def close(self) -> None:
        """Close the files and the progress line."""
        self.table.close()
        self.validation.close()
        if self._writer is not None:
            self._writer.close()
        self._bar.close()

    def _events(self, group: str, step: int, values: Mapping[str, float]) -> None:
        if self._writer is not None:
            for name, value in values.items():
                self._writer.add_scalar(f"{group}/{name}", value, step)


def _writer(folder: Path, purge_step: int) -> SummaryWriter | None:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        logger.info("tensorboard is not installed (extra 'train'): no events are written")
        return None
    # Events of the interrupted run from here on are hidden by TensorBoard.
    return SummaryWriter(str(folder), purge_step=purge_step)
