"""Files that went wrong: cut off, bits flipped, sections swapped or zeroed; and what a reader makes
of them.

As a program it reads damaged copies of one file in a process of its own, so that a crash or a hang
is seen from outside: ``python damage.py READER FOLDER COPIES [SECONDS [SEED]]`` prints a JSON
object of outcomes. With SECONDS it stops when they are over; COPIES is then the largest number.
"""

import collections
import json
import math
import shutil
import signal
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

SECONDS = 60
"""For one copy; a reader that takes longer hangs."""


def damaged(content: bytes, copies: int, seed: int = 0) -> Iterator[bytes]:
    """Copies of a file, in turn: cut off; bits flipped in the first kilobyte; bits flipped
    anywhere; two sections swapped; a section of zeros."""
    rng, n = np.random.default_rng(seed), len(content)
    for k in range(copies):
        broken = bytearray(content)
        size = int(rng.integers(1, max(2, n // 4)))
        a, b = np.sort(rng.integers(0, n - size + 1, 2))
        match k % 5:
            case 0:
                broken = broken[: int(rng.integers(0, n))]
            case 1 | 2:
                for at in rng.integers(0, min(1024, n) if k % 5 == 1 else n, 8):
                    broken[at] ^= 1 << int(rng.integers(0, 8))
            case 3:
                size = min(size, int(b - a))
                broken[a : a + size], broken[b : b + size] = (
                    content[b : b + size],
                    content[a : a + size],
                )
            case _:
                broken[a : a + size] = bytes(size)
        yield bytes(broken)


def _volume(ending: str) -> Callable[[Path], tuple[Path, Callable[[], Any]]]:
    def make(folder: Path) -> tuple[Path, Callable[[], Any]]:
        import torch

        from torchpcct import Volume, VolumeGrid

        target = folder / f"v{ending}"
        data = torch.round(
            300 * torch.randn((4, 12, 10), generator=torch.Generator().manual_seed(0))
        )
        Volume(data, VolumeGrid((4, 12, 10), (1.5, 0.5, 0.25), (3.0, -7.0, 11.0))).save(target)

        def read() -> list[Any]:
            volume = Volume.load(target)
            return [volume.data.numpy(), volume.grid]

        return (sorted(target.iterdir())[1] if target.is_dir() else target), read

    return make


def _lines() -> tuple[Any, Any]:
    from torchpcct import ConeBeam, full_turn

    cone = ConeBeam(full_turn(12), 300.0, 500.0, 24, 3, (1.5, 1.7), (0.25, 0.6), "curved")
    return cone, 0.5 + 0.1 * np.random.default_rng(0).standard_normal(cone.shape)


def _own(folder: Path) -> tuple[Path, Callable[[], Any]]:
    from torchpcct import Scan

    cone, lines = _lines()
    Scan.from_line_integrals(lines, cone, photons=1e4).save(folder / "own.h5")
    return folder / "own.h5", lambda: _scan(Scan.load(folder / "own.h5"))


def _scan(scan: Any) -> list[Any]:
    return [scan.counts.numpy(), scan.air.numpy(), scan.geometry]


def _data_exchange(folder: Path) -> tuple[Path, Callable[[], Any]]:
    from foreign_files import data_exchange

    from torchpcct.formats.scans import open_scan

    path, rng = folder / "beamline.h5", np.random.default_rng(0)
    data, white = rng.integers(900, 40000, (20, 3, 24)), rng.integers(39000, 41000, (4, 3, 24))
    dark, angles = rng.integers(99, 102, (2, 3, 24)), np.linspace(0, math.pi, 20)
    data_exchange(path, data, white, angles, dark, 40.0, chunks=(5, 3, 24), compression="gzip")
    return path, lambda: _scan(open_scan(path))


def _stack(part: str) -> Callable[[Path], tuple[Path, Callable[[], Any]]]:
    def make(folder: Path) -> tuple[Path, Callable[[], Any]]:
        import tifffile
        import yaml

        from torchpcct.formats.geometry_yaml import geometry_values
        from torchpcct.formats.scans import open_scan

        cone, lines = _lines()
        values = (5e4 * np.exp(-lines)).astype(np.float32)
        if part == "npy":
            np.save(folder / "all.npy", values)
        else:
            tifffile.imwrite(
                folder / "all.tif", values, compression="zlib" if part == "zlib" else None
            )
        text = {
            "readings": "all.npy" if part == "npy" else "all.tif",
            "kind": "counts",
            "air": 5e4,
            "geometry": geometry_values(cone),
        }
        (folder / "scan.yaml").write_text(yaml.safe_dump(text), encoding="utf-8")
        path = folder / ("scan.yaml" if part == "yaml" else text["readings"])
        return path, lambda: _scan(open_scan(folder / "scan.yaml"))

    return make


def _catsim(folder: Path) -> tuple[Path, Callable[[], Any]]:
    from torchpcct.formats.scans import open_scan

    cone, lines = _lines()
    lines.astype("<f4").tofile(folder / "a.prep")
    return folder / "a.prep", lambda: _scan(open_scan(folder / "a.prep", cone))


def _nexus(folder: Path) -> tuple[Path, Callable[[], Any]]:
    from foreign_files import nexus

    from torchpcct.formats.scans import open_scan

    rng = np.random.default_rng(0)
    data, white = rng.integers(900, 40000, (12, 3, 24)), rng.integers(39000, 41000, (4, 3, 24))
    path = nexus(folder / "a.nxs", data, white, np.linspace(0, math.pi, 12), pixel_um=40.0)
    return path, lambda: _scan(open_scan(path))


def _laboratory(name: str) -> Callable[[Path], tuple[Path, Callable[[], Any]]]:
    def make(folder: Path) -> tuple[Path, Callable[[], Any]]:
        from foreign_files import txrm, xtekct
        from scipy.io import savemat

        from torchpcct import ConeBeam, full_turn
        from torchpcct.formats.scans import open_scan

        cone = ConeBeam(full_turn(12, math.radians(120.0)), 300.0, 500.0, 24, 3, 1.7)
        readings = 5e4 * np.exp(-0.5 - 0.1 * np.random.default_rng(0).standard_normal(cone.shape))
        if name == "mat":
            savemat(folder / "a.mat", {"p": readings}, do_compression=True)
            return folder / "a.mat", lambda: _scan(open_scan(folder / "a.mat", cone, air=5e4))
        if name == "txrm":
            path = txrm(folder / "a.txrm", readings, cone, np.full((3, 24), 5e4))
        else:
            path = xtekct(folder / "part", readings, cone, 5e4)
        return path, lambda: _scan(open_scan(path))

    return make


def _zarr(part: str) -> Callable[[Path], tuple[Path, Callable[[], Any]]]:
    def make(folder: Path) -> tuple[Path, Callable[[], Any]]:
        target, read = _volume(".zarr")(folder)
        del target
        return folder / "v.zarr" / part, read

    return make


def _clinical(folder: Path) -> tuple[Path, Callable[[], Any]]:
    from foreign_files import ct_pd

    from torchpcct.formats.scans import open_scan

    cone, lines = _lines()
    where = ct_pd(folder / "projections", lines, cone)
    return sorted(where.iterdir())[3], lambda: _scan(open_scan(where))


def _rtk(folder: Path) -> tuple[Path, Callable[[], Any]]:
    from torchpcct.formats.rtk import read_rtk

    parts = []
    for angle in np.linspace(0, 2 * math.pi, 12, endpoint=False):
        c, s = math.cos(angle), math.sin(angle)
        turn = np.array([[c, 0, -s, 0], [0, 1, 0, 0], [s, 0, c, -300.0], [0, 0, 0, 1]])
        matrix = np.array([[-500.0, 0, 0, 0], [0, -500.0, 0, 0], [0, 0, 1, 0]]) @ turn
        parts.append(
            f"<Projection><Matrix>{' '.join(map(str, matrix.ravel()))}</Matrix></Projection>"
        )
    path = folder / "geometry.xml"
    path.write_text(
        f"<RTKGeometry><SourceToDetectorDistance>500</SourceToDetectorDistance>{''.join(parts)}</RTKGeometry>"
    )
    return path, lambda: [read_rtk(path, 24, 3, 1.5)]


def _weights(folder: Path) -> tuple[Path, Callable[[], Any]]:
    import torch

    from recon.mbir.weights_io import read_tensors, write_tensors

    path = folder / "w.safetensors"
    write_tensors(
        path,
        "test weights",
        {"a": torch.arange(300.0), "b": torch.ones(2, 3)},
        {"network": {"width": 3}},
    )

    def read() -> list[Any]:
        tensors, config = read_tensors(path, "test weights")
        return [tensors["a"].numpy(), tensors["b"].numpy(), config]

    return path, read


READERS: dict[str, Callable[[Path], tuple[Path, Callable[[], Any]]]] = {
    "scan": _own,
    "data exchange": _data_exchange,
    "npy": _stack("npy"),
    "tiff": _stack("tiff"),
    "tiff zlib": _stack("zlib"),
    "yaml": _stack("yaml"),
    "catsim": _catsim,
    "ct-pd": _clinical,
    "rtk": _rtk,
    "weights": _weights,
    "h5": _volume(".h5"),
    "nii": _volume(".nii"),
    "nii.gz": _volume(".nii.gz"),
    "mha": _volume(".mha"),
    "dicom": _volume(""),
    "nexus": _nexus,
    "xtekct": _laboratory("xtekct"),
    "txrm": _laboratory("txrm"),
    "mat": _laboratory("mat"),
    "zarr chunk": _zarr("0/c/0/0/0"),
    "zarr metadata": _zarr("zarr.json"),
}
"""File to damage and how it is read, made in a folder."""
SEALED = ("scan", "weights", "h5", "zarr chunk", "zarr metadata")
"""Our own formats, which carry a checksum: what they give is what was written, or an error that
names the file."""


def _same(a: Any, b: Any) -> bool:
    return len(a) == len(b) and all(
        x.shape == y.shape and x.dtype == y.dtype and x.tobytes() == y.tobytes()
        if isinstance(x, np.ndarray)
        else x == y
        for x, y in zip(a, b, strict=True)
    )


class _Slow(Exception):
    pass


def _hang(*_: Any) -> None:
    raise _Slow


def outcomes(
    name: str, folder: Path, copies: int, seed: int = 0, seconds: float = math.inf
) -> dict[str, int]:
    """How often each of ``same``, ``other`` (data that a format without checksum cannot tell from
    true ones), ``refused`` (a clear error) and anything worse, by its name and the number of the
    copy."""
    path, read = READERS[name](folder)
    content, truth = path.read_bytes(), read()
    found: collections.Counter[str] = collections.Counter()
    signal.signal(signal.SIGALRM, _hang)
    end = time.monotonic() + seconds
    for k, broken in enumerate(damaged(content, copies, seed)):
        if time.monotonic() > end:
            break
        path.write_bytes(broken)
        signal.alarm(SECONDS)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                found["same" if _same(truth, read()) else "other"] += 1
        except (ValueError, TypeError, FileNotFoundError) as error:
            clear = len(str(error)) > 10 and (name not in SEALED or path.name in str(error))
            found["refused" if clear else f"copy {k} says nothing: {error!r}"] += 1
        except Exception as error:
            found[f"copy {k}, {type(error).__name__}: {str(error)[:200]}"] += 1
        finally:
            signal.alarm(0)
    path.write_bytes(content)
    return dict(found)


if __name__ == "__main__":
    reader, where, number, *limits = sys.argv[1:]
    limit, first = (float(limits[0]) if limits else math.inf), (int(limits[1]) if limits[1:] else 0)
    made = Path(where)
    shutil.rmtree(made, ignore_errors=True)
    made.mkdir(parents=True)
    print(json.dumps(outcomes(reader, made, int(number), first, limit)))
