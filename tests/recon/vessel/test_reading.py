"""Readings of a drawn vessel with and without a core: figures, refusal, files."""

import json
from dataclasses import replace

import drawn_vessel
import numpy as np
import pytest
from drawn_vessel import VALUES
from refusals import refused
from threadpoolctl import threadpool_info, threadpool_limits

from recon.vessel import read_plaque, reading
from recon.vessel.figures import TissueEstimate
from recon.vessel.reading import _doubt
from recon.vessel.report import save, table

POINT_OFF = (0.0, 0.0, drawn_vessel.CORE_OFF)


@pytest.fixture(scope="module")
def strong(gram):
    """A core 100 HU below the fibrous tissue, with noise."""
    return read_plaque(
        drawn_vessel.data(gram, drawn_vessel.image(gram.finer, 100.0), seed=1), particles=150
    )


@pytest.fixture(scope="module")
def absent(gram):
    return read_plaque(
        drawn_vessel.data(gram, drawn_vessel.image(gram.finer, 0.0), seed=1), particles=150
    )


def test_a_core_is_found_and_its_figures_hold_the_truth(strong):
    assert strong.presence > 0.95
    assert not strong.refused
    figures = strong.figures
    for name, truth in (
        ("contrast", 100.0),
        ("fibrous", VALUES["fibrous"]),
        ("lumen", VALUES["lumen"]),
        ("lumen area", np.pi * drawn_vessel.LUMEN_MM**2),
    ):
        e = figures[name]
        assert abs(e.value - truth) < 3 * e.sd, name
        assert e.low < e.value < e.high
    assert figures["contrast"].sd < 40
    assert 0.9 < strong.chi2 < 1.1


def test_no_core_is_claimed_where_there_is_none(absent):
    assert absent.presence < 0.95
    assert "contrast" not in absent.figures
    assert "probability" in absent.refused["contrast"]
    assert "fibrous" in absent.figures


def test_regions_share_every_voxel_and_read_other_volumes(strong, gram):
    total = sum(strong.regions.values())
    assert np.allclose(total, 1.0, atol=0.03)
    found = strong.read(drawn_vessel.image(gram.grid, 100.0))
    assert found["fat"] == pytest.approx(VALUES["fat"], abs=3)
    assert found["contrast"] == pytest.approx(found["fibrous"] - found["core"])
    with pytest.raises(ValueError, match="reading's shape"):
        strong.read(np.zeros((2, 2, 2)))


def test_the_same_twice(gram):
    data = drawn_vessel.data(gram, drawn_vessel.image(gram.finer, 100.0, samples=2), seed=2)
    point = tuple(c + d for c, d in zip(gram.grid.center, POINT_OFF, strict=True))
    first, second = (read_plaque(data, point, particles=50, seed=3) for _ in range(2))
    assert first.figures == second.figures
    assert np.linalg.norm(np.array(first.info["core_center_mm"]) - point) < 1.0


def test_files(strong, absent, tmp_path, gram):
    others = {"truth": drawn_vessel.image(gram.grid, 100.0, samples=2)}
    files = save(strong, tmp_path / "a", others)
    assert all(f.stat().st_size > 0 for f in files)
    told = json.loads((tmp_path / "a" / "report.json").read_text())
    assert told["figures"]["contrast"]["value"] == strong.figures["contrast"].value
    assert told["same_regions"]["truth"]["lumen"] == pytest.approx(VALUES["lumen"], abs=5)
    assert "truth, same regions" in table(strong, others)
    assert "refused" in table(absent)


def test_refusals(gram):
    data = drawn_vessel.data(gram, drawn_vessel.image(gram.finer, 0.0, samples=1))
    refused(
        ("point_sd", lambda: read_plaque(data, point_sd=0.0)),
        ("particles", lambda: read_plaque(data, particles=3)),
        ("point must be 3 numbers", lambda: read_plaque(data, (1.0, 2.0))),
        ("VesselPrior, got tuple", lambda: read_plaque(data, vessel_prior=(50.0, 15.0))),
        ("NaN", lambda: read_plaque(replace(data, b=data.b * float("nan")))),
        ("one \\(z, y, x\\) grid", lambda: read_plaque(replace(data, b=data.b[:, 1:]))),
    )


@pytest.mark.parametrize(
    ("presence", "low", "high", "why"),
    [
        (0.94, 20.0, 80.0, "probability of 0.94"),
        (0.99, -130.0, 160.0, "several explanations"),
        (0.99, 20.0, 80.0, ""),
    ],
)
def test_doubt_has_a_reason(presence, low, high, why):
    found = _doubt(presence, TissueEstimate((low + high) / 2, low, high, (high - low) / 4, "HU"))
    assert why in found
    assert bool(found) == bool(why)


def test_one_blas_thread_reads_the_tissues(gram, monkeypatch):
    """Its matrices are so small that more threads take three times as long, and round in another
    order."""

    class Seen(Exception):
        pass

    def look(*_):
        seen.extend(pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas")
        raise Seen

    seen: list[int] = []
    monkeypatch.setattr(reading, "find_vessel", look)
    with threadpool_limits(4, user_api="blas"), pytest.raises(Seen):
        read_plaque(drawn_vessel.data(gram, drawn_vessel.image(gram.finer, 0.0)))
    assert set(seen) == {1}
