"""What benchmarks/reconstruct/sweep.py measured as tables, lines for each limit, and a plot of time against error."""

from __future__ import annotations

import argparse
from pathlib import Path
from statistics import median

from benchmarks.common.measure import machine, number, seconds_axis, table
from benchmarks.reconstruct.appearance import MATERIALS

OURS, PAPER = "gdtool", "gdtool, paper"  # its default method, and the paper's
LIMITS = {
    "clean": {
        "distance": 7e-4,
        "iou": 0.990,
        "seen_normal_degrees": 3.0,
        "shown_normal_degrees": 3.0,
        "seconds": 20.0,
        "peak_mb": 3072.0,
    },
    "perturbed": {
        "distance": 2.2e-3,
        "iou": 0.955,
        "seen_normal_degrees": 7.0,
        "shown_normal_degrees": 7.0,
        "seconds": 60.0,
        "peak_mb": 3072.0,
    },
    "materials": {"albedo_psnr": 30.0, "roughness_error": 0.06, "metallic_error": 0.06},
}
COLUMNS = (
    ("distance", "Chamfer, 1e-3", 1e3),
    ("seen_distance", "seen, 1e-3", 1e3),
    ("iou", "IoU", 1),
    ("seen_normal_degrees", "normal ° seen", 1),
    ("shown_normal_degrees", "to views' normals °", 1),
    ("normal_degrees", "normal °", 1),
    ("seconds", "seconds", 1),
    ("cpu_seconds", "CPU s", 1),
    ("peak_mb", "MB", 1),
    ("watertight", "closed", 1),
)
BY_MODEL = (*COLUMNS[:4], ("views_normal_degrees", "of the views °", 1), *COLUMNS[4:8])
TIE = 0.005  # of a distance: another seed of the 40,000 samples moves it by as much
PAPER_LIMITS = {"distance": 3e-3, "seconds": 600.0}  # of the paper's method on exact views without depth
TITLES = {
    "clean": "Exact views",
    "perturbed": "Disturbed views",
    "normals": "Exact views without depth",
    "color": "Color and mask only",
}


def kind(record: dict) -> str:
    """clean, perturbed, normals or color."""
    return record["case"].split()[0]


def middle(records: list[dict], name: str) -> float | None:
    """Median of a figure over the records that have it."""
    values = [float(r[name]) for r in records if name in r]
    return median(values) if values else None


def limit_of(method: str) -> float | None:
    """Seconds of a run with --budget; None of any other."""
    return float(method.split()[1]) if method.startswith(f"{OURS} ") else None


def figure(records: list[dict], name: str, factor: float) -> str:
    """The median as text."""
    value = middle(records, name)
    return number(None if value is None else value * factor)


def summary(records: list[dict], case: str) -> str:
    """Medians by method, each over the models it was run on."""
    chosen = [r for r in records if kind(r) == case]
    columns = (*COLUMNS, *(MATERIALS if any("albedo_psnr" in r for r in chosen) else ()))
    rows = []
    for method in dict.fromkeys(r["method"] for r in chosen):
        part = [r for r in chosen if r["method"] == method]
        cells = [
            f"{sum(bool(r.get('watertight')) for r in part)} of {len(part)}"
            if name == "watertight"
            else figure(part, name, factor)
            for name, _, factor in columns
        ]
        rows.append([method, *cells, str(sum("failed" in r for r in part))])
    return table(["method", *(head for _, head, _ in columns), "failed"], rows)


def best_peer(records: list[dict]) -> tuple[str, float | None]:
    """The peer with the least median Chamfer over these records, and that; of what was run on all cases a peer shares
    with ours."""
    peers = dict.fromkeys(r["method"] for r in records if not r["method"].startswith(OURS))
    found = {
        m: value for m in peers if (value := middle([r for r in records if r["method"] == m], "distance")) is not None
    }
    best = min(found, key=found.get) if found else ""
    return best, found.get(best)


def beside(own: float | None, theirs: float | None) -> str:
    """Whether our distance is not worse than a peer's."""
    return (
        ""
        if own is None or theirs is None
        else "yes"
        if own <= theirs
        else "tie"
        if own <= (1 + TIE) * theirs
        else "NO"
    )


def by_model(records: list[dict], case: str) -> str:
    """Our figures of every model beside the best peer's, case by case."""
    rows = []
    for model in dict.fromkeys(r["model"] for r in records):
        part = [r for r in records if r["model"] == model and kind(r) == case]
        mine = [r for r in part if r["method"] == OURS]
        if not mine:
            continue
        best, theirs = best_peer(part)
        own = middle(mine, "distance")
        rows.append(
            [
                model,
                *(figure(mine, n, f) for n, _, f in BY_MODEL),
                number(theirs * 1e3) if best else "–",
                best,
                beside(own, theirs),
            ]
        )
    return table(["model", *(head for _, head, _ in BY_MODEL), "best peer, 1e-3", "which", "not worse"], rows)


def by_budget(records: list[dict]) -> str:
    """Every --budget beside the best peer that was done by then in all of the same cases; medians over them."""
    rows = []
    for case in ("clean", "perturbed"):
        budgets = sorted({limit for r in records if kind(r) == case and (limit := limit_of(r["method"])) is not None})
        for budget in budgets:
            mine = [r for r in records if kind(r) == case and limit_of(r["method"]) == budget]
            cases = {(r["model"], r["case"]) for r in mine}
            ready = [
                r
                for r in records
                if (r["model"], r["case"]) in cases
                and limit_of(r["method"]) is None
                and r.get("seconds", 1e9) <= budget
            ]
            done = {
                m
                for m in {r["method"] for r in ready}
                if len({(r["model"], r["case"]) for r in ready if r["method"] == m}) == len(cases)
            }
            best, theirs = best_peer([r for r in ready if r["method"] in done and not r["method"].startswith(OURS)])
            own, slowest = middle(mine, "distance"), max((r.get("seconds", 0.0) for r in mine), default=0.0)
            rows.append(
                [
                    f"{case}, {budget:g} s",
                    figure(mine, "distance", 1e3),
                    figure(mine, "iou", 1),
                    number(slowest),
                    number(theirs * 1e3) if best else "–",
                    best,
                    beside(own, theirs),
                ]
            )
    return (
        table(["budget", "Chamfer, 1e-3", "IoU", "seconds, most", "best peer, 1e-3", "which", "not worse"], rows)
        if rows
        else ""
    )


def by_skip(records: list[dict]) -> str:
    """What every skip saves, median CPU seconds of doing the work that was left out, and what doing it would change."""
    rows = []
    skips = [skip for r in records for skip in r.get("skips", ())]
    for what in dict.fromkeys(s["what"] for s in skips):
        part = [s for s in skips if s["what"] == what]
        rows.append(
            [
                what,
                number(median(s["done"] for s in part)),
                number(median(s["skipped"] for s in part)),
                number(median(s["done"] - s["skipped"] for s in part)),
                number(1e3 * median(s["change"] for s in part)),
                str(len(part)),
            ]
        )
    return table(["skip", "CPU s without", "with", "saved", "change, 1e-3", "models"], rows) if rows else ""


def verdict(records: list[dict]) -> str:
    """A line for each limit."""
    lines = []
    for case, limits in LIMITS.items():
        mine = [r for r in records if r["method"] == OURS and kind(r) == ("clean" if case == "materials" else case)]
        for name, limit in limits.items():
            value = max((r[name] for r in mine if name in r), default=None) if name == "peak_mb" else middle(mine, name)
            if value is not None:
                least = name in ("iou", "albedo_psnr")
                lines.append(
                    f"- {case}: {'largest' if name == 'peak_mb' else 'median'} {name} {number(value)}, wanted "
                    f"{'≥' if least else '≤'} {limit:g}: "
                    + ("holds" if (value >= limit if least else value <= limit) else "**missed**")
                )
    papers = [r for r in records if r["method"] == PAPER]
    for name, limit in PAPER_LIMITS.items():
        value = middle(papers, name)
        if value is not None:
            lines.append(
                f"- the paper's method without depth: median {name} {number(value)}, wanted ≤ {limit:g}: "
                f"{'holds' if value <= limit else '**missed**'}"
            )
    return "\n".join(lines)


def markdown(records: list[dict], given: argparse.Namespace, remark: str) -> str:
    """The report."""
    count, disturbed = len({r["model"] for r in records}), {r["case"] for r in records if kind(r) == "perturbed"}
    parts = [
        "# Reconstruction: six views to a surface",
        "",
        f"By `benchmarks/reconstruct/sweep.py` on {machine()}; {count} models, views of {given.size}², "
        f"{len(disturbed)} disturbances (seed, and "
        f"wavelength as a share of the picture). Medians. {remark}",
        "",
        "Chamfer: point to surface, mean of both directions, largest extent of the truth 1. IoU: closed truths only. "
        "Seen: where one of the six",
        "views looks. Seconds of ours hold start-up, reading and writing; a peer's are its algorithm alone. Tie: "
        "within half a",
        "percent, by which another seed of the samples moves a distance.",
        "",
        verdict(records),
        "",
    ]
    for case, title in TITLES.items():
        if any(kind(r) == case for r in records):
            parts += [f"## {title}", "", summary(records, case), "", by_model(records, case), ""]
    for title, text in (("Anytime: `--budget`", by_budget(records)), ("What is skipped", by_skip(records))):
        parts += [f"## {title}", "", text, ""] if text else []
    failed = [f"- {r['model']}, {r['case']}, {r['method']}: {r['failed']}" for r in records if "failed" in r]
    return "\n".join(
        [*parts, *(["## Failed", "", *failed, ""] if failed else []), "![time against error](reconstruct.png)", ""]
    )


def plot(records: list[dict], path: Path) -> None:
    """Time against Chamfer and IoU, medians by method; our budgets joined by a line."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    cases = [case for case in TITLES if any(kind(r) == case for r in records)]
    picture, axes = plt.subplots(2, len(cases), figsize=(6 * len(cases), 7), layout="constrained", squeeze=False)
    for column, case in enumerate(cases):
        for row, (name, label) in enumerate((("distance", "Chamfer"), ("iou", "IoU"))):
            axis, budgets = axes[row, column], []
            for method in dict.fromkeys(r["method"] for r in records):
                part = [r for r in records if r["method"] == method and kind(r) == case]
                seconds, value = middle(part, "seconds"), middle(part, name)
                if seconds is None or value is None:
                    continue
                if limit_of(method) is not None:
                    budgets.append((seconds, value))
                else:
                    axis.plot(seconds, value, "o" if method == OURS else "s", label=method, markersize=9)
            if budgets:
                axis.plot(*zip(*sorted(budgets), strict=True), ".-", color="grey", label=f"{OURS} --budget")
            if name in LIMITS.get(case, {}):
                axis.axhline(LIMITS[case][name], color="grey", linestyle=":")
            axis.set(ylabel=label, title=TITLES[case], yscale="log" if name == "distance" else "linear")
            seconds_axis(axis)
            if axis.has_data():
                axis.legend(fontsize=8)
    picture.savefig(path, dpi=110)
    plt.close(picture)
