"""The page that shows volumes in a browser: what it holds, and, where Playwright and a Chromium
are, what it does."""

import base64
import json
import re
import shutil
import zlib

import numpy as np
import pytest
import torch

from torchpcct import Volume, VolumeGrid
from torchpcct.viz import base64_text, viewer_page


def _volumes():
    draw = torch.Generator().manual_seed(0)
    fine = 300 * torch.randn(7, 12, 10, generator=draw)
    coarse = 40 * torch.randn(3, 5, 4, generator=draw)
    return (
        (
            "fine <b>",
            Volume(fine, VolumeGrid((7, 12, 10), (1.0, 0.5, 0.5), (2.0, -30.0, 10.0))),
            0.0,
            900.0,
        ),
        (
            "coarse",
            Volume(coarse, VolumeGrid((3, 5, 4), (2.0, 1.25, 1.5), (2.5, -30.5, 10.0))),
            0.0,
            200.0,
        ),
    )


def _decoded(page):
    """Values of the volumes of a page, and what it says of them."""
    about = json.loads(
        re.search(r'<script id="volumes" type="application/json">(.*?)</script>', page)[1]
    )
    for number, volume in enumerate(about):
        coded = re.search(
            rf'<script id="data{number}" type="text/plain">(.*?)</script>', page, re.DOTALL
        )[1]
        low, high = (
            np.frombuffer(zlib.decompress(base64.b64decode(coded)), np.uint8)
            .astype(int)
            .reshape(2, -1)
        )
        codes = (low + 256 * high).reshape(volume["shape"])
        yield volume, np.where(codes == 65535, np.nan, volume["low"] + volume["step"] * codes)


def test_a_page_holds_the_volumes_and_no_address():
    volumes = _volumes()
    page = viewer_page(volumes, "a & b")
    assert "http" not in page.lower()
    assert "<title>a &amp; b</title>" in page
    assert "{{" not in page
    assert "<b>" not in page
    for (label, volume, level, width), (about, values) in zip(volumes, _decoded(page), strict=True):
        np.testing.assert_allclose(values, volume.data, atol=0.0501)
        assert (about["label"], about["level"], about["width"], about["unit"]) == (
            label,
            level,
            width,
            "HU",
        )
        assert about["spacing"] == list(volume.grid.spacing)
        assert about["center"] == list(volume.grid.center)


def test_letters_say_where_right_and_front_are():
    """As every other format has them: x to the right, y to the front, z to the head."""
    page = viewer_page(_volumes(), "v")
    assert 'const ENDS = [["I", "S"], ["P", "A"], ["L", "R"]];' in page  # of z, y, x
    for plane in (
        '"axial", across: 2, up: 1',
        '"coronal", across: 2, up: 0',
        '"sagittal", across: 1, up: 0',
    ):
        assert plane in page
    assert page.count("letters(p, c)") == 2


@pytest.mark.parametrize("scale", [1e-6, 0.02, 1.0, 3e4])
def test_any_range_of_values_is_kept_to_its_ten_thousandths(scale):
    data = scale * torch.linspace(-0.3, 1.0, 24).reshape(2, 3, 4)
    data[0, 0, 1], data[1, 1, 1] = torch.nan, torch.inf
    for unit in ("HU", "mm^-1"):
        page = viewer_page(
            [("v", Volume(data, VolumeGrid((2, 3, 4), 1.0), unit=unit), 0.0, 1.0)], "v"
        )
        (_, values), *_ = _decoded(page)
        assert np.isnan(values).sum() == 2
        off = max(2e-4 * scale, 0.0501 if unit == "HU" else 0.0)
        np.testing.assert_allclose(values[np.isfinite(values)], data[data.isfinite()], atol=off)
    flat = Volume(torch.full((3, 4), scale), VolumeGrid((3, 4), 1.0), unit="mm^-1")
    (about, values), *_ = _decoded(viewer_page([("flat", flat, 0.0, 1.0)], "flat"))
    assert about["shape"] == [1, 3, 4]
    np.testing.assert_allclose(values, scale, rtol=1e-4)


def test_what_no_page_can_show_is_refused(monkeypatch):
    grid = VolumeGrid((1, 2, 2), 1.0)
    pixels = Volume(torch.zeros(1, 2, 2), grid, unit="pixel^-1")
    mm = Volume(torch.zeros(1, 2, 2), grid)
    with pytest.raises(ValueError, match="one unit of length, got mm and pixels"):
        viewer_page([("a", pixels, 0.0, 1.0), ("b", mm, 0.0, 1.0)], "t")
    with pytest.raises(ValueError, match="a has no finite value"):
        viewer_page([("a", Volume(torch.full((1, 2, 2), torch.nan), grid), 0.0, 1.0)], "t")
    monkeypatch.setattr("torchpcct.viz._MOST_VOXELS", 7)
    with pytest.raises(ValueError, match="too many for one page"):
        viewer_page([("a", mm, 0.0, 1.0), ("b", mm, 0.0, 1.0)], "t")
    chance = base64.b64decode("abhttpcd")
    assert "http" not in base64_text(chance)
    assert base64.b64decode(base64_text(chance)) == chance


@pytest.fixture
def page(tmp_path):
    """The page of :func:`_volumes` in Chromium; its ``requests`` are all that it asked for."""
    playwright = pytest.importorskip("playwright.sync_api")
    (tmp_path / "view.html").write_text(viewer_page(_volumes(), "test"), encoding="utf-8")
    with playwright.sync_playwright() as started:
        own = next(
            filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
        )
        try:
            browser = started.chromium.launch(executable_path=own, args=["--no-sandbox"])
        except playwright.Error as error:
            pytest.skip(f"no Chromium: {str(error).splitlines()[0]}")
        page = browser.new_page(viewport={"width": 1100, "height": 800})
        page.requests, page.errors = [], []
        page.on("request", lambda request: page.requests.append(request.url))
        page.on("pageerror", lambda error: page.errors.append(str(error)))
        page.goto((tmp_path / "view.html").as_uri())
        page.wait_for_selector("body[data-ready]")
        yield page
        browser.close()


def _pixels(page, canvas):
    page.evaluate("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
    return page.locator("canvas").nth(canvas).evaluate("canvas => canvas.toDataURL()")


def _said(page):
    """Position that values are read at (z, y, x in mm), and the cells of each volume's row."""
    page.evaluate("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
    x, y, z = map(float, re.findall(r"-?\d+\.\d+", page.inner_text("#where")))
    rows = page.locator("#readings tr").all()
    return (z, y, x), [row.locator("td").all_inner_texts() for row in rows]


def _indices(grid, position):
    return [
        round((mm - c) / s + (n - 1) / 2)
        for mm, n, s, c in zip(position, grid.shape, grid.spacing, grid.center, strict=True)
    ]


def test_the_page_does_what_it_says(page):
    volumes = [v for _, v, _, _ in _volumes()]
    box = page.locator("canvas").nth(0).bounding_box()  # axial, of the fine volume

    def at(across, down):
        return box["x"] + across * box["width"], box["y"] + down * box["height"]

    ends = [canvas.get_attribute("data-ends") for canvas in page.locator("canvas").all()]
    # left, right, top, bottom of axial, coronal, sagittal
    assert ends == ["L R A P", "L R S I", "P A S I"] * 2
    # Values under the pointer, of both volumes, on different grids.
    checked = 0
    for across, down in ((0.23, 0.31), (0.47, 0.52), (0.81, 0.33), (0.37, 0.77), (0.02, 0.02)):
        page.mouse.move(*at(across, down))
        position, rows = _said(page)
        for volume, cells in zip(volumes, rows, strict=True):
            index = _indices(volume.grid, position)
            if not all(0 <= k < n for k, n in zip(index, volume.grid.shape, strict=True)):
                assert cells[1] == "–"
                continue
            assert float(cells[1].split()[0]) == pytest.approx(
                float(volume.data[tuple(index)]), abs=0.051
            )
            checked += 1
            if volume is volumes[0]:  # and so grey is the picture there: window 0 ± 450 HU
                grey = 255 * min(max(float(volume.data[tuple(index)]) / 900 + 0.5, 0), 1)
                found = (
                    page.locator("canvas")
                    .nth(0)
                    .evaluate(
                        "(canvas, [a, b]) => canvas.getContext('2d').getImageData(a, b, 1, "
                        "1).data[0]",
                        [int(across * box["width"]), int(down * box["height"])],
                    )
                )
                assert found == pytest.approx(grey, abs=1.1)
    assert checked >= 6
    # The wheel moves through the slices of both.
    before = [_pixels(page, k) for k in (0, 3)]
    page.mouse.move(*at(0.5, 0.52))
    start, _ = _said(page)
    page.mouse.wheel(0, -100)
    (z, *_), _ = _said(page)
    assert z == pytest.approx(start[0] + volumes[0].grid.spacing[0], abs=0.006)
    assert all(_pixels(page, k) != old for k, old in zip((0, 3), before, strict=True))
    # A drag changes the window, and with it the pixels of both.
    before, width = [_pixels(page, k) for k in (0, 3)], float(page.input_value("#width"))
    page.mouse.down()
    page.mouse.move(*at(0.9, 0.52), steps=3)
    page.mouse.up()
    assert all(_pixels(page, k) != old for k, old in zip((0, 3), before, strict=True))
    assert float(page.input_value("#width")) > width
    # A click moves the cursor of all planes.
    page.mouse.click(*at(0.31, 0.36))
    clicked, _ = _said(page)
    caption = page.locator("figcaption").nth(5).inner_text()  # sagittal, of the coarse volume
    assert caption == f"coarse: sagittal, x = {clicked[2]:.2f} mm"
    # Mean ± SD in a circle.
    page.check("input[value=circle]")
    page.mouse.move(*at(0.5, 0.5))
    center, _ = _said(page)
    page.mouse.down()
    page.mouse.move(*at(0.83, 0.5), steps=3)
    page.mouse.up()
    edge, rows = _said(page)
    for volume, cells in zip(volumes, rows, strict=True):
        _, y, x = volume.grid.axes
        radius = np.hypot(edge[1] - center[1], edge[2] - center[2])
        inside = np.hypot(y[:, None] - center[1], x - center[2]) < radius
        values = volume.data[_indices(volume.grid, center)[0]].numpy()[inside]
        assert int(cells[3]) == values.size > 2
        mean, sd = (float(text) for text in re.findall(r"-?\d+\.\d+", cells[2]))
        assert (mean, sd) == pytest.approx((values.mean(), values.std(ddof=1)), abs=0.11)
    # Keys: the cursor by a voxel, a slice, the ROI.
    page.mouse.move(5, 5)
    page.locator("canvas").nth(0).focus()
    (z, y, x), _ = _said(page)
    page.keyboard.press("PageDown")
    page.keyboard.press("ArrowRight")
    page.keyboard.press("Escape")
    (z1, y1, x1), rows = _said(page)
    assert (z1, y1) == pytest.approx((z - 1.0, y), abs=0.006)
    assert 0.0 < x1 - x <= 0.756  # to the centre of the next voxel
    assert rows[0][2] == "–"
    assert [url for url in page.requests if not url.startswith(("file:", "data:", "blob:"))] == []
    assert page.errors == []
