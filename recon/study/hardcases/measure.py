"""Every case by every method: the error against the sound scan of the same noise, its warnings, the
verdict.

The error against the truth, beside that of soft FBP from the same scan, says whether a method makes
a case worse than need be: a prior or weights that the case fools.
"""

from __future__ import annotations

import re
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch

from recon import reconstruct
from recon.evaluate.anatomies import ANATOMIES
from recon.jobs.execute import captured_warnings
from recon.jobs.store import Step, StudyCache
from recon.study.hardcases.anatomies import METHODS as ANATOMY_METHODS
from recon.study.hardcases.anatomies import anatomy_rows
from recon.study.hardcases.cases import (
    CASES,
    CONE_GRID,
    GRID,
    Case,
    balls,
    body_scan,
    body_truth,
    cone_scan,
    cone_truth,
    untouched,
)
from recon.study.paper.plaque_scan import rod_values
from recon.study.study import Measured, Progress, StudySettings, silent
from torchpcct.acquisition.acquire import acquire
from torchpcct.geometry import VolumeGrid
from torchpcct.scan import NOISE_FREE_EXPOSURE_S, Scan
from torchpcct.scanner import Scanner, presets
from torchpcct.scene import Scene
from torchpcct.scene.phantoms import thorax
from torchpcct.scene.plaque import Plaque, plaque_scene
from torchpcct.validate import choice, number
from torchpcct.volume import Volume

if TYPE_CHECKING:
    from matplotlib.figure import Figure


RIGHT_NOISES = 0.5
"""A result is right if what the case adds is at most half of the noise that the sound scan has
anyway: 12 % more."""
WORSE = 1.05
"""A method that is further from the truth than soft FBP of the same scan by more than this
factor has to say so."""
DISEASE = (
    "ulcer",
    "thrombus",
    "flap",
    "calcification",
    "stent",
    "inflamed_30",
    "inflamed_15",
    "branch",
    "second",
    "thin_cap",
    "stenosis",
    "occlusion",
)
"""Anatomies that break what a prior for vessels assumes."""
_ROWS = 20
"""Detector rows of the plaque's scan."""
_GRID_MM = (6.4, 9.2, 9.2)
"""Size of its inset, mm."""
_COLOURS = {"right": "tab:green", "warned": "tab:orange", "unseen": "tab:grey", "SILENT": "tab:red"}
"""Of the verdicts."""


@dataclass(frozen=True)
class HardcasesSettings(StudySettings):
    """Settings of the hard cases; the quick ones have an eighth of the views, FBP alone, every
    case.

    Args:
        views: of the plaque's scan that is made hard, at least 120.
        exposure_s: its exposure in s.
        voxel_mm: voxel size of its inset.
        seed: of the noise, and of what is broken at random.
        methods: of :func:`recon.reconstruct`; ``"tissues"``: MBIR with them, of some scans of the
            plaque. The cone beam is reconstructed by FBP alone.
        cases: names of :data:`recon.study.hardcases.cases.CASES`.
        anatomies: names of :data:`recon.evaluate.anatomies.ANATOMIES`.
        anatomy_methods: of :data:`recon.study.hardcases.anatomies.METHODS`.
        draws: of the noise of each anatomy, beside the scan without noise.
    """

    views: int = 360
    exposure_s: float = 2.0
    voxel_mm: float = 0.4
    seed: int = 0
    methods: tuple[str, ...] = ("fbp", "pwls", "mbir", "tissues")
    cases: tuple[str, ...] = tuple(CASES)
    anatomies: tuple[str, ...] = DISEASE
    anatomy_methods: tuple[str, ...] = ANATOMY_METHODS
    draws: int = 3

    QUICK: ClassVar = {
        "views": 120,
        "methods": ("fbp",),
        "anatomies": ("ulcer",),
        "anatomy_methods": ("pwls", "mbir"),
        "draws": 1,
    }

    def __post_init__(self) -> None:
        self.check_whole(views=120, seed=0, draws=0)
        number("exposure_s", self.exposure_s, positive=True, unit="s")
        number("voxel_mm", self.voxel_mm, positive=True, unit="mm")
        for name in ("methods", "cases"):
            if isinstance(getattr(self, name), str) or not getattr(self, name):
                raise ValueError(f"{name} must be one name or more, got {getattr(self, name)!r}")
        for name in self.cases:
            choice("case", name, CASES)
        for name in self.anatomies:
            choice("anatomy", name, ANATOMIES)
        for name in self.anatomy_methods:
            choice("method of an anatomy", name, ANATOMY_METHODS)


def verdict(
    error_hu: float | None,
    noise_hu: float,
    finite: bool,
    messages: list[str],
    noise: float = 1.0,
    worse: float = 1.0,
    unseen: str = "",
) -> str:
    """``right``, ``warned`` (wrong or refused, with a message), ``unseen`` (the data cannot show
    it) or ``SILENT`` (wrong without a word).

    Args:
        error_hu: rms error in HU; None: refused.
        noise_hu: rms noise of the sound result.
        finite: whether all values are.
        messages: warnings and refusals beside those of the sound scan.
        noise: of :class:`recon.study.hardcases.cases.Case`: what it adds is no error.
        worse: error against the truth over that of soft FBP; more than :data:`WORSE` is not right.
        unseen: why the data cannot show it, or empty.
    """
    allowed = (RIGHT_NOISES + 1.3 * max(noise**2 - 1.0, 0.0) ** 0.5) * noise_hu
    if error_hu is not None and finite and error_hu <= allowed and worse <= WORSE:
        return "right"
    return "warned" if messages else "unseen" if unseen else "SILENT"


def measure(
    settings: HardcasesSettings, progress: Progress = silent, folder: str | Path | None = None
) -> Measured:
    """Reconstruct every case by every method; see :mod:`recon.study.study`.

    ``rows`` of the data, one for each case and method: ``case``, ``base``, ``title``, ``method``,
    ``error_hu`` (rms of the difference to the sound scan's volume, of another scene what it adds to
    the error against the truth; None if refused), ``noise_hu`` (rms of the sound scan's noise),
    ``finite``, ``messages`` (warnings, or the refusal), ``refused``, ``seconds``, ``verdict``,
    ``truth_hu`` (rms of the difference to the truth), ``soft_hu`` (that of soft FBP from the same
    scan; either is None if refused). ``anatomies``: rows of
    :func:`recon.study.hardcases.anatomies.anatomy_rows`.
    """
    cache = StudyCache(folder, settings)
    bases = {name: _BASES[name](settings, cache.within(name), progress) for name in _used(settings)}
    sound, cases, anatomies = _steps(settings)
    cache.ahead(*sound)
    for k, (name, method) in enumerate(_pairs(settings)):
        bases[name].sound(method)
        progress("sound scans", (k + 1) / len(sound))
    cache.ahead(*cases)
    rows = []
    for k, name in enumerate(settings.cases):
        rows += _case(settings, cache, name, bases[CASES[name].base])
        progress("cases", (k + 1) / len(settings.cases))
    diseased = []
    cache.ahead(*anatomies)
    for k, name in enumerate(settings.anatomies):
        diseased += _anatomy(settings, cache, name, bases["plaque"])
        progress("anatomies", (k + 1) / len(settings.anatomies))
    counts = Counter(row["verdict"] for row in rows)
    data = {
        "anatomies": diseased,
        "rows": rows,
        "cases": len(settings.cases),
        "verdicts": dict(counts),
        "silent": counts["SILENT"],
    }
    return Measured(settings, data)


def plan(settings: HardcasesSettings, folder: str | Path | None) -> None:
    """List the jobs that are left; see :mod:`recon.study.study`."""
    StudyCache(folder, settings).plan(*_steps(settings))


def _steps(settings: HardcasesSettings) -> tuple[Step, Step, Step]:
    """Sound scans, what is done to them, other anatomies: each step needs the one before it."""
    return (
        (_sound, _pairs(settings)),
        (_case, [(name,) for name in settings.cases]),
        (_anatomy, [(name,) for name in settings.anatomies]),
    )


def _used(settings: HardcasesSettings) -> list[str]:
    """The bases of the cases and anatomies."""
    used = {CASES[name].base for name in settings.cases}
    return [name for name in _BASES if name in used or (settings.anatomies and name == "plaque")]


def _pairs(settings: HardcasesSettings) -> list[tuple[str, str]]:
    """Base and method of each volume of a sound scan."""
    return [(b, m) for b in _used(settings) for m in settings.methods if m in _METHODS[b]]


@dataclass(frozen=True)
class _Base:
    """A sound scan, and what is known of it.

    Attributes:
        scene, clean, noisy, grid, truth: of it.
        simulate, truth_of: of another scene.
        plaque: in it, or None.
        cache: for what they give.
    """

    scene: Scene
    clean: Scan
    noisy: Scan
    grid: VolumeGrid
    truth: torch.Tensor
    simulate: Callable[[Scene], Scan]
    truth_of: Callable[[Scene], torch.Tensor]
    plaque: Plaque | None
    cache: StudyCache
    _sound: dict[str, tuple[torch.Tensor, list[str], float]] = field(default_factory=dict)

    def sound(self, method: str) -> tuple[torch.Tensor, list[str], float]:
        """What a method makes of it: volume, warnings, rms noise."""

        def compute() -> tuple[torch.Tensor, list[str], float]:
            with captured_warnings("recon", "torchpcct", alone=True) as messages:
                volume = _reconstruct(self.noisy, self.grid, method)
                noise = _rms(volume.data - _reconstruct(self.clean, self.grid, method).data)
            return volume.data, [*volume.report.get("warnings", ()), *messages], noise

        if method not in self._sound:
            self._sound[method] = self.cache(f"sound_{method}", compute)
        return self._sound[method]


def _plaque_base(settings: HardcasesSettings, cache: StudyCache, progress: Progress) -> _Base:
    scene, plaque = plaque_scene(vessel_length=_GRID_MM[0] - 0.2)
    scanner = presets.pcct(views=settings.views)
    scanner = scanner.replace(geometry=replace(scanner.geometry, rows=_ROWS))
    shape = tuple(round(e / settings.voxel_mm) for e in _GRID_MM)
    grid = VolumeGrid(shape, settings.voxel_mm, plaque.position[::-1])
    region = VolumeGrid((1, 1, 1), _GRID_MM, plaque.position[::-1])
    duty = settings.views / presets.PCCT_VIEWS

    def simulate(scene: Scene) -> Scan:
        return acquire(
            scene,
            scanner,
            region=region,
            duty=min(duty, 1.0),
            progress=lambda f: progress("simulate", f),
        )

    truth_of = partial(_truth, scanner=scanner, grid=grid)
    clean = cache("scan", partial(simulate, scene))
    noisy = clean.with_noise(settings.exposure_s, settings.seed)
    truth = cache("truth", partial(truth_of, scene))
    return _Base(scene, clean, noisy, grid, truth, simulate, truth_of, plaque, cache)


def _body_base(settings: HardcasesSettings, cache: StudyCache, progress: Progress) -> _Base:
    scene = thorax()
    clean = cache("scan", partial(body_scan, scene))
    noisy = clean.with_noise(NOISE_FREE_EXPOSURE_S, settings.seed)
    return _Base(scene, clean, noisy, GRID, body_truth(scene), body_scan, body_truth, None, cache)


def _cone_base(settings: HardcasesSettings, cache: StudyCache, progress: Progress) -> _Base:
    scene = balls()
    clean = cache("scan", partial(cone_scan, scene))
    noisy = clean.with_noise(NOISE_FREE_EXPOSURE_S, settings.seed)
    return _Base(
        scene, clean, noisy, CONE_GRID, cone_truth(scene), cone_scan, cone_truth, None, cache
    )


_BASES = {"plaque": _plaque_base, "body": _body_base, "cone": _cone_base}
"""How the sound scan of each base is made."""
_METHODS = {
    "plaque": ("fbp", "pwls", "mbir", "tissues"),
    "body": ("fbp", "pwls", "mbir"),
    "cone": ("fbp",),
}
"""That are for these scans. The object in the cone beam goes on above and below what all views see:
iterative methods would have to put that somewhere, and say so of the sound scan, too."""


def _reconstruct(scan: Scan, grid: VolumeGrid, method: str) -> Volume:
    """By a method of :func:`recon.reconstruct`; "tissues": MBIR with them, "soft": FBP with that
    kernel."""
    options: Any = {"tissues": {"tissues": True}, "soft": {"kernel": "soft"}}.get(method, {})
    return reconstruct(
        scan, grid, {"tissues": "mbir", "soft": "fbp"}.get(method, method), **options
    )


def _sound(settings: HardcasesSettings, cache: StudyCache, name: str, method: str) -> None:
    """What a method makes of the sound scan of this name."""
    _BASES[name](settings, cache.within(name), silent).sound(method)


def _case(
    settings: HardcasesSettings, cache: StudyCache, name: str, base: _Base | None = None
) -> list[dict[str, object]]:
    """A row for each method; without ``base``, its sound scan, this is computed or read first."""
    base = base or _BASES[CASES[name].base](settings, cache.within(CASES[name].base), silent)
    cache = cache.within(f"case_{name}")
    case, clean, noisy, truth = CASES[name], base.clean, base.noisy, base.truth
    seen, lost = torch.ones(base.grid.shape).bool(), case.noise
    if case.scene is not None:
        scene = case.scene(base.plaque or Plaque())
        clean = cache("scan", partial(base.simulate, scene))
        noisy = clean.with_noise(noisy.exposure_s or NOISE_FREE_EXPOSURE_S, settings.seed)
        truth = cache("truth", partial(base.truth_of, scene))
        grid = base.grid
        if grid.ndim == 2:
            grid = VolumeGrid((1, *grid.shape), (1.0, *grid.spacing), (0.0, *grid.center))
        seen = torch.from_numpy(untouched(scene, base.scene, grid)).reshape(base.grid.shape)
        if base.clean.exterior is not None and clean.exterior is not None:
            lost *= float(base.clean._at_window(base.clean.exterior / clean.exterior).mean()) ** 0.5
    try:
        scan: Scan | Exception = case.apply(clean, noisy, np.random.default_rng(settings.seed))
    except (ValueError, TypeError) as error:
        scan = error

    def soft_error() -> float | None:
        volume = _tried(scan, base.grid, "soft")[0]
        return None if volume is None else _rms((volume.data - truth)[seen])

    soft = cache("soft", soft_error)
    rows = []
    for method in settings.methods:
        if method not in _METHODS[case.base] or (method == "tissues" and not case.tissues):
            continue
        run = partial(_row, scan, base, method, case, truth, seen, lost, soft)
        row = cache(method, run)
        rows.append({"case": name, "base": case.base, "title": case.title, "method": method, **row})
    return rows


def _anatomy(
    settings: HardcasesSettings, cache: StudyCache, name: str, base: _Base | None = None
) -> list[dict[str, object]]:
    """See :func:`recon.study.hardcases.anatomies.anatomy_rows`."""
    base = base or _BASES["plaque"](settings, cache.within("plaque"), silent)
    return anatomy_rows(
        name,
        base.clean,
        base.grid,
        exposure_s=settings.exposure_s,
        seed=settings.seed,
        draws=settings.draws,
        methods=settings.anatomy_methods,
        reconstruct=_reconstruct,
        kind=_kind,
        cache=cache.within(f"anatomy_{name}"),
    )


def _truth(scene: Scene, scanner: Scanner, grid: VolumeGrid) -> torch.Tensor:
    """``grid.shape`` HU of a scene at rest: each tissue reads what a rod of it does at the
    plaque's place."""
    tissues = {b.name: b.material for b in scene.bodies if b.name in plaque_scene()[0].names}
    hu = rod_values(scene, scanner, grid.center[::-1], tissues)
    values = {name: hu.get(name, 0.0) for name in scene.names}  # what a case adds is left out
    return torch.from_numpy(scene.render(grid, values)).float()


def _tried(
    scan: Scan | Exception, grid: VolumeGrid, method: str
) -> tuple[Volume | None, list[str], float]:
    """A volume, the warnings, and seconds; no volume but its message where the scan or method is
    refused."""
    start = time.perf_counter()
    with captured_warnings("recon", "torchpcct", alone=True) as messages:
        try:
            if isinstance(scan, Exception):
                raise scan
            volume = _reconstruct(scan, grid, method)
        except (ValueError, TypeError) as error:
            return None, [str(error)], time.perf_counter() - start
    seconds = time.perf_counter() - start
    return volume, list(dict.fromkeys([*volume.report.get("warnings", []), *messages])), seconds


def _row(
    scan: Scan | Exception,
    base: _Base,
    method: str,
    case: Case,
    truth: torch.Tensor,
    seen: torch.Tensor,
    lost: float,
    soft: float | None,
) -> dict[str, object]:
    """A case by a method; ``seen``: the voxels that count, ``lost``: ``noise`` of
    :func:`verdict`."""
    sound, usual, noise = base.sound(method)
    volume, texts, seconds = _tried(scan, base.grid, method)
    error_hu = truth_hu = None
    finite, more, worse = True, texts, 1.0
    if volume is not None:
        finite = bool(torch.isfinite(volume.data).all())
        error_hu, truth_hu = (_rms((volume.data - other)[seen]) for other in (sound, truth))
        if case.other:
            error_hu = max(truth_hu**2 - _rms((sound - base.truth)[seen]) ** 2, 0.0) ** 0.5
        kinds = set(map(_kind, usual))
        more = [t for t in texts if _kind(t) not in kinds]
        # The standard kernel is sharper and noisier than the soft one by intent.
        worse = 1.0 if soft is None or method == "fbp" else truth_hu / soft
    return {
        "error_hu": error_hu,
        "noise_hu": noise,
        "finite": finite,
        "messages": texts,
        "refused": volume is None,
        "seconds": seconds,
        "verdict": verdict(error_hu, noise, finite, more, lost, worse, case.unseen),
        "truth_hu": truth_hu,
        "soft_hu": soft,
    }


def _kind(text: str) -> str:
    """A warning without its figures: the same one with others says nothing new."""
    return re.sub(r"[-\d.…]+", "#", text)


def _rms(difference: torch.Tensor) -> float:
    return float(difference.double().square().mean().sqrt())


def figures(measured: Measured) -> dict[str, Figure]:
    """Error over noise of every case, a panel per method; refused cases have no bar."""
    from matplotlib.figure import Figure

    methods, cases = measured.settings.methods, measured.settings.cases
    figure = Figure(
        figsize=(4.2 * len(methods) + 2, 0.24 * len(cases) + 1.2), dpi=150, layout="constrained"
    )
    panels = figure.subplots(1, len(methods), sharey=True, squeeze=False)[0]
    for panel, method in zip(panels, methods, strict=True):
        for r in measured.data["rows"]:
            k = cases.index(r["case"])
            if r["method"] != method:
                continue
            if r["error_hu"] is None or not r["finite"]:
                panel.text(
                    0.011, k, "refused" if r["refused"] else "not finite", va="center", fontsize=7
                )
            else:
                panel.barh(
                    k,
                    max(r["error_hu"] / r["noise_hu"], 0.0105),
                    color=_COLOURS[r["verdict"]],
                    height=0.7,
                )
        panel.axvline(RIGHT_NOISES, color="black", linewidth=0.8, linestyle=":")
        panel.set(
            xscale="log", xlim=(0.01, None), xlabel="error / noise of the sound scan", title=method
        )
    panels[0].set_yticks(range(len(cases)), [CASES[name].title for name in cases], fontsize=7)
    panels[0].invert_yaxis()
    return {"hardcases.png": figure}
