"""Which rankings of the paper's tables are established, and what ten realisations would find."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from recon.study.noise.claims import CLAIMS
from recon.study.noise.few_runs import Pair, few_run_tables, kendall, pair_differences, resampled_tables
from recon.study.noise.measure import Measured
from recon.study.paper import facts as paper
from recon.study.paper.tables import published
from recon.study.report import markdown_table

__all__ = ["claims_data", "claims_section", "pairs_data", "pairs_section"]

_BOOTSTRAP = 40_000
_ESTABLISHED = 0.975
"""Share of bootstrap resamples in which a claim must hold to count as established (its complement: refuted)."""


def _published_cnr(m: Measured, exposure: float) -> Any:
    """The paper's CNR of every setting, or None where it does not give all of them."""
    entries = [published(paper.CNR, k, v, exposure) for k, v in m.axes]
    return None if any(e is None for e in entries) else np.array(entries, dtype=float)


def _range(values: Any) -> list[float]:
    """Median between the ends of the 95 % range."""
    quantiles: list[float] = np.quantile(values, [0.025, 0.5, 0.975]).tolist()
    return quantiles


def claims_data(m: Measured, exposure: float) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """The paper's conclusions, each against the truth, n realisations, and experiments of ten."""
    axes, s = m.axes, m.settings
    covariance = m.covariance / exposure
    exact = m.exact(exposure)
    shared = few_run_tables(m.expected, covariance, 10, s.experiments, s.seed)
    own = few_run_tables(m.expected, covariance, 10, s.experiments, s.seed + 1, [int(100 * v) for _, v in axes])
    boot = resampled_tables(m.means[exposure], _BOOTSTRAP, s.seed)
    rows = []
    for claim in CLAIMS:
        if not set(claim.needs) <= set(axes):
            continue
        share = float(claim.holds(boot, axes).mean())
        verdict = "established" if share >= _ESTABLISHED else "refuted" if share <= 1 - _ESTABLISHED else "open"
        rows.append(
            {
                "claim": claim.text,
                "exact": bool(claim.holds(exact, axes)),
                "bootstrap_share": share,
                "verdict": verdict,
                "ten_run_share": float(claim.holds(shared, axes).mean()),
                "ten_run_share_own_scans": float(claim.holds(own, axes).mean()),
            }
        )
    winners = np.bincount(shared.cnr.argmax(-1), minlength=len(axes)) / s.experiments
    half = s.experiments // 2
    shares: dict[str, Any] = {
        "experiments": s.experiments,
        "winners": {f"{k} {v:.2f} mm": float(w) for (k, v), w in zip(axes, winners, strict=True)},
        "tau_exact_shared": _range(kendall(shared.cnr, exact.cnr)),
        "tau_exact_own": _range(kendall(own.cnr, exact.cnr)),
        "tau_between_experiments": _range(kendall(shared.cnr[:half], shared.cnr[half : 2 * half])),
    }
    theirs = _published_cnr(m, exposure)
    if theirs is not None:
        agreement = kendall(shared.cnr, theirs)
        shares["tau_paper_exact"] = float(kendall(theirs, exact.cnr))
        shares["tau_paper_shared"] = _range(agreement)
        shares["same_order_as_paper_shared"] = float((agreement == 1).mean())
        if {("soft", 0.25), ("soft", 0.20)} <= set(axes):
            a, b = axes.index(("soft", 0.25)), axes.index(("soft", 0.20))
            limit = theirs[a] / theirs[b]
            shares["soft_quarter_over_fifth"] = {
                "paper": float(limit),
                "exact": float(exact.cnr[a] / exact.cnr[b]),
                "share_shared": float((shared.cnr[:, a] >= limit * shared.cnr[:, b]).mean()),
                "share_own_scans": float((own.cnr[:, a] >= limit * own.cnr[:, b]).mean()),
            }
    return rows, shares


def claims_section(m: Measured, claims: list[dict[str, Any]], shares: dict[str, Any]) -> str:
    exposure = m.settings.table_exposure_s
    rows = [
        [
            c["claim"],
            "yes" if c["exact"] else "no",
            f"{c['verdict']} ({100 * c['bootstrap_share']:.1f} %)",
            f"{100 * c['ten_run_share']:.1f} %",
            f"{100 * c['ten_run_share_own_scans']:.1f} %",
        ]
        for c in claims
    ]
    n = m.settings.realizations
    table = markdown_table(
        ["the paper's conclusion", "exact", f"by n = {n}", "10-run experiments", "own scans per voxel size"], rows
    )
    top = sorted(shares["winners"].items(), key=lambda e: -e[1])[:6]
    text = (
        f"## Which rankings are established ({exposure:g} s)\n\n"
        "“exact”: whether it holds in our simulation without sampling error. "
        f"“by n = {n}”: established (refuted) if it holds in at least {100 * _ESTABLISHED:g} % (at most "
        f"{100 * (1 - _ESTABLISHED):g} %) of the paired bootstrap resamples. Last columns: how often an experiment of "
        f"10 realisations comes to the paper's conclusion ({shares['experiments']} experiments drawn from the exact "
        "joint law), if all settings are reconstructed from the same scans, and if every voxel size gets its own scans."
    )
    low, middle, high = shares["tau_between_experiments"]
    parts = [
        text,
        table,
        "Setting with the highest CNR in 10-run experiments: "
        + ", ".join(f"{name} {100 * share:.0f} %" for name, share in top)
        + f". Kendall's τ between the rankings of two such experiments: median {middle:.2f}, 95 % range {low:.2f} … "
        f"{high:.2f}.",
    ]
    if "tau_paper_exact" in shares:
        low, middle, high = shares["tau_exact_own"]
        parts.append(
            f"The paper's ranking of the settings agrees with the exact one by τ = {shares['tau_paper_exact']:.2f}; "
            f"10-run experiments with scans of their own per voxel size reach {middle:.2f} ({low:.2f} … {high:.2f}). "
            f"The paper's complete order was met by {100 * shares['same_order_as_paper_shared']:.2f} % of the "
            "experiments."
        )
    if "soft_quarter_over_fifth" in shares:
        r = shares["soft_quarter_over_fifth"]
        parts.append(
            f"The paper's CNR at soft 0.25 mm is {r['paper']:.2f} times that at 0.20 mm; exact is {r['exact']:.3f}. "
            f"From the same scans an experiment of 10 reads such a ratio in {100 * r['share_shared']:.2f} % of cases "
            f"(the two images share their noise), with scans of their own in {100 * r['share_own_scans']:.1f} %: "
            "neighbouring voxel sizes of the paper's tables do not seem to share their noise."
        )
    return "\n\n".join(parts)


def pairs_data(m: Measured, exposure: float) -> dict[str, Any]:
    """CNR differences: the paper's best against all others, and how many of all pairs are established."""
    axes, exact = m.axes, m.exact(exposure)
    best = ("soft", 0.25) if ("soft", 0.25) in axes else axes[int(np.argmax(exact.cnr))]
    a = axes.index(best)
    others = [(a, b) for b in range(len(axes)) if b != a]
    values = m.means[exposure]
    single = pair_differences(values, exact, others, draws=_BOOTSTRAP, seed=m.settings.seed)
    every = list(itertools.combinations(range(len(axes)), 2))
    level = 1 - 0.05 / len(every)
    joint = pair_differences(values, exact, every, level=level, draws=_BOOTSTRAP, seed=m.settings.seed)
    found = [p for p in joint if p.established]
    theirs, agree = _published_cnr(m, exposure), None
    if theirs is not None:
        agree = sum(np.sign(p.difference) == np.sign(theirs[p.first] - theirs[p.second]) for p in found)
    return {
        "reference": f"{best[0]} {best[1]:.2f} mm",
        "against": [
            {
                "kernel": axes[p.second][0],
                "voxel_mm": axes[p.second][1],
                "difference": p.difference,
                "interval": [p.low, p.high],
                "exact": p.exact,
                "runs_needed": _runs_needed(p, len(values)),
            }
            for p in single
        ],
        "pairs": len(every),
        "established_jointly": len(found),
        "with_the_right_sign": sum(np.sign(p.difference) == np.sign(p.exact) for p in found),
        "in_the_papers_order": agree,
    }


def _runs_needed(p: Pair, n: int) -> float:
    """Paired realisations for an 80 % chance that a 95 % interval excludes zero."""
    error = (p.high - p.low) / (2 * 1.96)
    return float(n * ((1.96 + 0.84) * error / p.exact) ** 2) if p.exact else float("inf")


def pairs_section(m: Measured, pairs: dict[str, Any]) -> str:
    rows = [
        [
            f"{p['kernel']} {p['voxel_mm']:.2f} mm",
            f"{p['exact']:+.3f}",
            f"{p['difference']:+.3f} [{p['interval'][0]:+.3f}, {p['interval'][1]:+.3f}]",
            "yes" if p["interval"][0] > 0 or p["interval"][1] < 0 else "no",
            f"{p['runs_needed']:.0f}" if p["runs_needed"] < 1e6 else "> 10⁶",
        ]
        for p in pairs["against"]
    ]
    n = m.settings.realizations
    table = markdown_table(
        [f"CNR of {pairs['reference']} minus that of", "exact", f"n = {n}, 95 %", "established", "runs needed"], rows
    )
    order = pairs["in_the_papers_order"]
    text = (
        f"Of all {pairs['pairs']} pairs of settings, {pairs['established_jointly']} differ at n = {n} with joint 95 % "
        f"confidence (Bonferroni), {pairs['with_the_right_sign']} of them with the exact sign"
    )
    text += "." if order is None else f"; the paper orders {order} of them the same way."
    return (
        "### Pairwise differences\n\nPaired bootstrap intervals. “runs needed”: paired realisations for an 80 % chance "
        f"that the 95 % interval excludes zero.\n\n{table}\n\n{text}"
    )
