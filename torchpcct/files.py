"""Atomic writes, and HDF5 files that name the software that wrote them and are refused when
damaged or foreign."""

from __future__ import annotations

import errno
import functools
import glob
import hashlib
import io
import os
import platform
import re
import secrets
import shutil
import signal
import stat
import sys
import tempfile
import threading
import time
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchpcct.hdf5 import require_inside

if TYPE_CHECKING:
    from types import FrameType

    import h5py
    from _typeshed import ReadableBuffer


__all__ = ["WriteError"]

LEFTOVER = re.compile(r"\.(?P<process>\d+)-(?P<machine>[0-9a-f]{6})-[0-9a-f]{8}\.part\.")
"""Names of what is being written begin so: the process, where it runs, and a number of this
write alone."""
_BLOCK = 512
"""Bytes in front of an HDF5 file that hold its checksum: the smallest user block."""
_ABANDONED_S = 60.0
"""Seconds without a write after which a temporary file counts as abandoned."""
_LONGEST_WAIT_S = 60.0
"""Seconds that a write waits for others that write the same files: far longer than renames take."""
_PAUSE_S = 0.02
"""Seconds between two looks whether they have ended."""
_MAGIC = b"torchpcct, HDF5 from byte 512, SHA-256 of it: "
"""Beginning of that block."""
_HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
"""First bytes of an HDF5 file."""

VERSION = "0.2.0"
"""Version of this software. pyproject.toml reads it from here; files carry it."""


def speak_any_encoding() -> None:
    """Let standard output and error replace what the terminal's encoding lacks, instead of ending
    the program.

    Containers and cron speak ASCII, Windows code pages: a line with µ, ± or an ellipsis must not
    cost the result.
    """
    for stream in (sys.stdout, sys.stderr):
        encoding = (getattr(stream, "encoding", None) or "utf-8").lower().replace("-", "")
        if encoding != "utf8" and isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def require_folder(path: str | os.PathLike[str]) -> None:
    """Raise ``FileNotFoundError`` unless the folder that ``path`` would be written to exists, or
    ``NotADirectoryError`` if a file is in its place."""
    parent = Path(path).parent
    for folder in (parent, *parent.parents):
        try:
            mode = folder.stat().st_mode  # once: it may be removed and made again meanwhile
        except OSError:
            continue
        if stat.S_ISDIR(mode):
            break
        raise NotADirectoryError(
            f"cannot write {path}: {folder} is a file, no folder; choose another folder"
        )
    if not parent.is_dir():
        raise FileNotFoundError(
            f"cannot write {path}: the folder {parent} does not exist, create it first"
        )


def require_ordinary(path: str | os.PathLike[str]) -> None:
    """Raise ``ValueError`` if a path is a device, a pipe or a socket, which may never end, or never
    begin; of a folder, if anything in it is. Links count as what they lead to.

    A path that is not there passes: whoever opens it says so.
    """
    given = Path(path)
    try:
        mode = given.stat().st_mode
    except OSError:
        return
    kinds = (
        (stat.S_ISCHR, "a device"),
        (stat.S_ISBLK, "a device"),
        (stat.S_ISFIFO, "a pipe"),
        (stat.S_ISSOCK, "a socket"),
    )
    for is_kind, kind in kinds:
        if is_kind(mode):
            raise ValueError(f"{given} is {kind}, not a file: copy what it gives into a file first")
    if stat.S_ISDIR(mode):
        for place, _, names in os.walk(given):
            for name in names:
                require_ordinary(os.path.join(place, name))


def require_writable(folder: str | os.PathLike[str]) -> None:
    """Make a folder, and raise ``OSError`` if it is a file or nothing can be written into it."""
    path = Path(folder)
    if path.exists() and not path.is_dir():
        raise NotADirectoryError(f"{path} is a file: name a folder to write to")
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise type(error)(
            f"cannot write into {path} ({error.strerror or error}): name another folder"
        ) from error


class WriteError(OSError):
    """A file could not be written, say to a full disk; nothing of it is left, and what was there
    before is."""


def _write_error(path: Path, cause: Exception) -> WriteError:
    """In one sentence: libraries make pages of the system's error, with its words somewhere."""
    text = str(cause).strip()
    number = getattr(cause, "errno", None)
    number = number or next(
        (n for n in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG) if os.strerror(n) in text), None
    )
    why = os.strerror(number) if number else (text.splitlines() or [type(cause).__name__])[0]
    error = WriteError(f"cannot write {path}: {why}")
    error.errno = number
    return error


@functools.cache
def _machine() -> str:
    """Six digits of where a process number means one process: this machine, or this container."""
    try:
        space = os.readlink("/proc/self/ns/pid")
    except OSError:
        space = ""
    return hashlib.sha256(f"{platform.node()} {space}".encode()).hexdigest()[:6]


def _part(target: Path, process: int) -> Path:
    """A new temporary name; with the target's ending, as some writers choose the format by it."""
    return target.with_name(f".{process}-{_machine()}-{secrets.token_hex(4)}.part.{target.name}")


def abandoned(part: Path, seconds: float = 0.0) -> bool:
    """Whether the writer of a temporary file is dead, by all that can be known here: that of
    another machine is not.

    Args:
        part: temporary file or folder; of any other name it is none.
        seconds: for which nothing has been written to it.
    """
    owner = LEFTOVER.match(part.name)
    if owner is None or owner["machine"] != _machine():
        return False
    try:
        if time.time() - part.stat().st_mtime < seconds:
            return False
        os.kill(int(owner["process"]), 0)
    except ProcessLookupError:
        return True
    except OSError:  # of another user: alive; or gone, by its own writer
        pass
    return False


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary name beside ``path``, for a file or a folder; flush what is there to the
    disk, rename it.

    Whoever reads ``path`` at any moment, also after a crash, finds the old content or the new one,
    whole; so do any number of processes and threads that write it at once. On any failure what is
    temporary is removed; what a killed process left is removed by the next write of the same name,
    a minute later. A folder takes the place of none, or of an empty one.

    Raises:
        FileNotFoundError: the folder of ``path`` does not exist.
        WriteError: the system refuses to write.
    """
    target = Path(path)
    require_folder(target)
    for left in target.parent.glob(f".*.part.{glob.escape(target.name)}"):
        if abandoned(left, _ABANDONED_S):
            _remove(left)
    part = _part(target, os.getpid())
    try:
        yield part
        _sync(part)
        os.replace(part, target)
        _sync(target.parent)
    except WriteError:
        raise
    except FileNotFoundError as error:
        raise FileNotFoundError(f"cannot write {target}: its folder has been removed") from error
    except OSError as error:
        raise _write_error(target, error) from error
    finally:
        _remove(part)


@contextmanager
def marker(folder: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a new empty file in a folder, by which other machines see that the disk is the same;
    gone after the block.

    What a killed process left is removed by the next one.
    """
    for left in Path(folder).glob(".*.part.marker"):
        if abandoned(left):
            _remove(left)
    part = _part(Path(folder) / "marker", os.getpid())
    part.touch()
    try:
        yield part
    finally:
        _remove(part)


def write_together(folder: str | os.PathLike[str], contents: Mapping[str, bytes]) -> list[Path]:
    """Write files that belong together: all of them or, where one cannot be written, none.

    Of processes that write the same files at once, one has written all that is there at the end.

    Args:
        folder: it exists.
        contents: file name → its content.

    Raises:
        FileNotFoundError: the folder does not exist.
        WriteError: the system refuses to write.
    """
    out = Path(folder)
    with ExitStack() as stack:
        parts = {name: stack.enter_context(atomic_write(out / name)) for name in contents}
        for name, part in parts.items():
            try:
                with part.open("wb") as file:
                    file.write(contents[name])
                    file.flush()
                    os.fsync(file.fileno())
            except OSError as error:
                raise _write_error(out / name, error) from error
        finished = stack.pop_all()
    with alone(out, wait_s=_LONGEST_WAIT_S), finished:
        pass
    return [out / name for name in contents]


class FolderInUseError(OSError):
    """Another process holds the folder."""


@contextmanager
def alone(folder: str | os.PathLike[str], wait_s: float | None = None) -> Iterator[None]:
    """Hold a folder during a block, against other blocks of any process that hold it; a process
    that dies holds it no longer.

    Where the system has no such locks (Windows, some network drives) nothing is held, nor where
    the folder does not exist.

    Args:
        folder: to hold. No file is made in it.
        wait_s: how long to wait for others, in s; after that the block runs all the same. None: it
            is refused at once.

    Raises:
        FolderInUseError: another one holds it, and ``wait_s`` is None.
    """
    try:
        import fcntl

        handle = os.open(folder, os.O_RDONLY)
    except (ImportError, OSError):
        yield
        return
    try:
        until = time.monotonic() + (wait_s or 0.0)
        while True:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                if wait_s is None:
                    raise FolderInUseError(
                        f"another process writes into {folder}: wait until it has ended, or name "
                        "another folder"
                    ) from None
                if time.monotonic() < until:
                    time.sleep(_PAUSE_S)
                    continue
            except OSError:  # no locks of folders on this drive
                pass
            break
        yield
    finally:
        os.close(handle)


class _Unfailing(io.FileIO):
    """A file for HDF5, which crashes when it closes a file that it could not write, or at the end
    of the program.

    The first failure is kept in ``failure``; all that is written after it goes nowhere.
    """

    failure: BaseException | None = None

    def write(self, data: ReadableBuffer, /) -> int:
        rest = memoryview(data).cast("B")
        size = len(rest)
        try:
            while len(rest) and self.failure is None:
                rest = rest[super().write(rest) :]
        except BaseException as error:
            self.failure = error
        return size

    def truncate(self, size: int | None = None, /) -> int:
        try:
            return super().truncate(size)
        except BaseException as error:
            self.failure = self.failure or error
            return size or 0

    def readinto(self, buffer: Any, /) -> int:
        there = super().readinto(buffer) or 0
        buffer[there:] = bytes(len(buffer) - there)
        return len(buffer)


@contextmanager
def _signals_wait() -> Iterator[None]:
    """Put off what Python does at signals (Ctrl-C) to the end of a block: an exception in the
    middle of what HDF5 asks of a file would lose a write silently."""
    if threading.current_thread() is not threading.main_thread():
        yield  # Python serves signals in the main thread only
        return
    came: list[tuple[int, FrameType | None]] = []
    found = {int(n): signal.getsignal(n) for n in signal.valid_signals()}
    handlers = {
        n: handler
        for n, handler in found.items()
        if callable(handler) and not isinstance(handler, int)
    }
    try:
        for n in handlers:
            signal.signal(n, lambda number, frame: came.append((number, frame)))
        yield
    finally:
        for n, handler in handlers.items():
            signal.signal(n, handler)
        for number, frame in came:
            handlers[number](number, frame)


@contextmanager
def write_hdf5(path: str | os.PathLike[str], kind: str) -> Iterator[h5py.File]:
    """Yield a new HDF5 file of the format ``torchpcct-KIND``, written whole or not at all and
    sealed.

    HDF5 checks neither its data nor its structure, and a damaged structure can make it wait
    forever. So the first 512 bytes, which HDF5 leaves to the user, hold the SHA-256 of all the
    others: :func:`read_hdf5` compares it before HDF5 sees the file.

    Raises:
        FileNotFoundError: the folder of ``path`` does not exist.
        WriteError: the system refuses to write.
    """
    import h5py

    with atomic_write(path) as part:
        with _signals_wait(), _Unfailing(part, "w+b") as raw:
            try:
                with h5py.File(raw, "w", userblock_size=_BLOCK) as file:
                    # no structure is thrown out, to be read back from nowhere
                    cache = file.id.get_mdc_config()
                    (
                        cache.evictions_enabled,
                        cache.incr_mode,
                        cache.flash_incr_mode,
                        cache.decr_mode,
                    ) = False, 0, 0, 0
                    file.id.set_mdc_config(cache)
                    file.attrs["format"] = f"torchpcct-{kind}"
                    yield file
            except Exception:  # HDF5 may stumble over what it could not write
                if raw.failure is None:
                    raise
            if raw.failure is not None:
                raise raw.failure
        seal(part)


def seal(path: str | os.PathLike[str]) -> None:
    """Write the checksum of a file of :func:`write_hdf5`, also after it was changed on purpose."""
    with open(path, "r+b") as file:
        file.seek(_BLOCK)
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        file.seek(0)
        file.write((_MAGIC + digest.encode() + b"\n").ljust(_BLOCK, b"\0"))


def is_sealed(path: str | os.PathLike[str]) -> bool:
    """Whether a file begins with the checksum of :func:`write_hdf5`, right or wrong."""
    with open(path, "rb") as file:
        return file.read(len(_MAGIC)) == _MAGIC


def fingerprint(path: str | os.PathLike[str]) -> str:
    """SHA-256 of a file, or of the names and contents of all files of a folder, in the order of
    their names."""
    given = Path(path)
    if not given.is_dir():
        with given.open("rb") as content:
            return hashlib.file_digest(content, "sha256").hexdigest()
    total = hashlib.sha256()
    for file in sorted(p for p in given.iterdir() if p.is_file()):
        total.update(f"{file.name} {fingerprint(file)};".encode())
    return total.hexdigest()


def is_own_hdf5(path: str | os.PathLike[str], kind: str) -> bool:
    """Whether an HDF5 file is of the format ``torchpcct-KIND``, sound or not."""
    import h5py

    try:
        require_ordinary(path)
        with h5py.File(path, "r") as file:
            return bool(file.attrs.get("format") == f"torchpcct-{kind}")
    except (OSError, RuntimeError, ValueError, KeyError):
        return False


def _check_seal(path: str | os.PathLike[str], kind: str) -> None:
    require_ordinary(path)
    with open(path, "rb") as file:
        head = file.read(_BLOCK)
        if head.startswith(_HDF5_SIGNATURE):
            return  # of an earlier version without checksum, or foreign
        if not head.startswith(_MAGIC):
            raise ValueError(
                f"{path} is not a torchpcct {kind}, or its beginning is damaged: take another copy"
            )
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    if head != (_MAGIC + digest.encode() + b"\n").ljust(_BLOCK, b"\0"):
        raise ValueError(
            f"{path} is truncated or damaged: its content does not have the checksum that it was "
            "written with; take another copy of it, or make it again"
        )


@contextmanager
def read_hdf5(path: str | os.PathLike[str], kind: str) -> Iterator[h5py.File]:
    """Open an HDF5 file whose attribute ``format`` is ``torchpcct-KIND``, for a block that reads
    it.

    The checksum of a file of :func:`write_hdf5` is verified before.

    Raises:
        FileNotFoundError: no such file.
        ValueError: the file is truncated, altered, of another format, or the block does not find
            what it looks for.
    """
    import h5py

    try:
        _check_seal(path, kind)
        with h5py.File(path, "r") as file:
            if file.attrs.get("format") != f"torchpcct-{kind}":
                raise ValueError(f"{path} is an HDF5 file, but not a torchpcct {kind}")
            require_inside(file)
            yield file
    except FileNotFoundError:
        raise
    # a damaged file without checksum can make h5py, or what is built from it, fail anyhow
    except Exception as error:
        if isinstance(error, ValueError) and str(path) in str(error):
            raise
        raise ValueError(
            f"{path} cannot be read as a torchpcct {kind} (truncated, damaged or foreign): {error}"
        ) from error


def _sync(path: Path) -> None:
    # A rename can reach the disk before the content does: without this, a power cut may leave an
    # empty file.
    if LEFTOVER.match(path.name) and path.is_dir():
        for inside in path.iterdir():
            _sync(inside)
    try:
        handle = os.open(path, os.O_RDONLY)
    except OSError:  # folders cannot be opened on some systems, which sync them by themselves
        return
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


_FIRST_MEMBER = (30, b"key.npy")
"""Where the name of a ZIP archive's first file stands, and which it is in a cached
result: by it a damaged one is known."""


def is_foreign(path: Path) -> bool:
    """Whether something is there that is no cached result (:mod:`recon.jobs.store`), not even
    a damaged or older one."""
    try:
        if path.is_symlink() or not path.is_file():
            return path.is_symlink() or path.exists()
        with path.open("rb") as raw:
            try:
                with zipfile.ZipFile(raw) as file:
                    return not {"key.npy", "sum.npy", "tree.npy"} <= set(file.namelist())
            except Exception:  # a damaged archive can fail in any way
                at, name = _FIRST_MEMBER
                raw.seek(0)
                head = raw.read(at + len(name))
                return not (head.startswith(b"PK") and head[at:] == name)
    except FileNotFoundError:  # cleared by others meanwhile
        return False
