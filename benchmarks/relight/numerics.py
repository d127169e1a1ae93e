"""What float32-safe forms buy: the paper's literal formulas and the usual textbook forms beside ours, all against
float64.

    python -m benchmarks.relight.numerics                 writes docs/benchmarks/numerics.md, .json and .png
    python -m benchmarks.relight.numerics -o /tmp/report

Everything is computed in float32 as a program would; the reference is float64 quadrature, or for evaluation and
products the exact formula in 50 digits. Only this file holds the literal forms."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import mpmath
import numpy as np
import torch

from gdtool.shading.bsdf import sg
from gdtool.shading.bsdf.closed_form import shade_parts
from tests.stress.references import N, direction, light, reflected, ring_integrals, sphere_integral

SHARPNESS = (0.1, 1.0, 10.0, 100.0, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8)
F = torch.float32


def literal_lobe(axis, sharpness, v):
    """exp(λ(v·p − 1)), as written in every paper."""
    return torch.exp(sharpness * (sg.dot(v, axis) - 1))


def literal_product(axis1, sharpness1, axis2, sharpness2):
    """Axis λ₁p₁ + λ₂p₂, its length λ, and λ − λ₁ − λ₂ as the logarithm of the amplitude."""
    total = sharpness1[..., None] * axis1 + sharpness2[..., None] * axis2
    length = total.norm(dim=-1)
    return total / length[..., None], length, length - sharpness1 - sharpness2


def literal_hemisphere(sharpness, cosine):
    """Meder & Brüderlin 2018 as printed: the upper hemisphere's integral, shared by a hyperbolic tangent."""
    t = (
        torch.sqrt(sharpness)
        * (1.6988 * sharpness**2 + 10.8438 * sharpness)
        / (sharpness**2 + 6.2201 * sharpness + 10.2415)
    )
    share = 0.5 * (1 + torch.tanh(0.5 * t * cosine) / torch.tanh(0.5 * t))
    return 2 * torch.pi / sharpness * (1 - torch.exp(-sharpness)) * (share + (1 - share) * torch.exp(-sharpness))


def lobes_of(sharpness, cosine, narrow):
    """An axis at the cosine times a lobe about the pole: sharpness, log amplitude, cosine of the product."""
    axis = torch.stack([torch.sqrt((1 - cosine**2).clamp_min(0)), 0 * cosine, cosine], -1)
    pole = torch.tensor([0.0, 0.0, 1.0]).expand_as(axis)
    axis, length, drop = literal_product(axis, sharpness, pole, torch.full_like(sharpness, narrow))
    return length, drop, axis[..., 2]


def literal_cosine_integral(sharpness, cosine):
    """The paper: cosine = 32.7080 exp(0.0315 (c − 1)) − 31.7003, each product an SG, integrated over the hemisphere."""
    length, drop, up = lobes_of(sharpness, cosine, 0.0315)
    return 32.7080 * drop.exp() * literal_hemisphere(length, up) - 31.7003 * literal_hemisphere(sharpness, cosine)


def one_lobe_cosine_integral(sharpness, cosine):
    """The clamped cosine as one lobe of sharpness 2.133 and amplitude 1.17, as engines use it (Pettineo 2016)."""
    length, drop, _ = lobes_of(sharpness, cosine, 2.133)
    return 1.17 * drop.exp() * sg.integral(length)


def literal_specular(view, roughness, lights, keep_denominator: bool):
    """The paper's lobe: λ = 2/r⁴, μ = 1/(π r⁴) about the mirror direction, warped, times the light; F = 1.

    Without the denominator 1 / (4 (n·o)(n·i)), as its text drops it, or with Schlick-GGX's V at the mirror direction.
    """
    n_v = sg.dot(N, view)
    a2 = torch.tensor(roughness**4)
    k = (roughness + 1) ** 2 / 8
    masking = (n_v / (n_v * (1 - k) + k)) ** 2 / (4 * n_v * n_v if keep_denominator else 1)
    mirror = 2 * n_v * N - view
    axis, length, drop = literal_product(mirror, 2 / a2 / (4 * n_v), lights.axes[0], lights.sharpness[0])
    return float(
        masking / (torch.pi * a2) * drop.exp() * literal_cosine_integral(length[None], sg.dot(axis, N)[None])[0]
    )


def evaluation() -> list[dict]:
    """Largest relative error where the lobe is between 1 and e⁻⁸."""
    out = []
    for value in SHARPNESS[1:]:
        angles = np.minimum(np.linspace(0.1, 4, 40) / np.sqrt(value), np.pi)
        v = torch.tensor(np.stack([np.sin(angles), 0 * angles, np.cos(angles)], 1), dtype=F)
        # A general axis: on a coordinate axis the dot product would be exact.
        turn = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)))[0]
        v, p, s = (v.double() @ turn.T).float(), turn[:, 2].float(), torch.tensor(value, dtype=F)
        exact = sg.lobe(p.double(), s.double(), v.double())
        out.append(
            {
                "sharpness": value,
                "textbook": worst(literal_lobe(p, s, v), exact),
                "ours": worst(sg.lobe(p, s, v), exact),
            }
        )
    return out


def worst(got, exact) -> float:
    return float(((got.double() - exact) / exact).abs().max())


def product() -> list[dict]:
    """Largest error of the product's amplitude (relative) over gaps of 0.01 … 2 lobe widths, both lobes equally
    sharp."""
    out = []
    for value in SHARPNESS[1:]:
        errors = {"textbook": 0.0, "ours": 0.0}
        for width in (0.01, 0.1, 0.5, 1.0, 2.0):
            gap = min(width / np.sqrt(value), 3.0)
            p1, p2 = (torch.tensor([np.sin(a), 0.6 * np.cos(a), 0.8 * np.cos(a)], dtype=F) for a in (0.3, 0.3 + gap))
            s = torch.tensor(value, dtype=F)
            with mpmath.workdps(50):
                a, b = ([mpmath.mpf(float(x)) for x in v] for v in (p1, p2))
                a, b = ([x / mpmath.sqrt(sum(y * y for y in v)) for x in v] for v in (a, b))
                exact = float(
                    mpmath.exp(
                        mpmath.sqrt(sum((x + y) ** 2 for x, y in zip(a, b, strict=True))) * mpmath.mpf(float(s))
                        - 2 * mpmath.mpf(float(s))
                    )
                )
            for name, form in (("textbook", literal_product), ("ours", sg.product)):
                errors[name] = max(errors[name], abs(float(form(p1, s, p2, s)[2].exp()) / exact - 1))
        out.append({"sharpness": value, **errors})
    return out


def integrals() -> tuple[list[dict], list[dict]]:
    """Cosine as a share of its peak, hemisphere as a share of the sphere's integral: the largest over 91 angles."""
    cosine_rows, half_rows = [], []
    c = torch.tensor(np.cos(np.linspace(0, np.pi, 91)), dtype=F)
    for value in SHARPNESS:
        s = torch.full_like(c, value)
        exact, half = (torch.tensor(x) for x in ring_integrals(float(s[0]), c.double().numpy()))
        forms = {"paper": literal_cosine_integral, "one lobe": one_lobe_cosine_integral, "ours": sg.cosine_integral}
        got = {name: form(s, c).double() for name, form in forms.items()}
        cosine_rows.append(
            {
                "sharpness": value,
                **{name: float((x - exact).abs().max() / exact.max()) for name, x in got.items()},
                "paper's least value": float(got["paper"].min() / exact.max()),
            }
        )
        half_rows.append(
            {
                "sharpness": value,
                "Meder & Brüderlin": float((literal_hemisphere(s, c).double() - half).abs().max())
                / sphere_integral(float(s[0])),
                "ours": float((sg.hemisphere_integral(s, c).double() - half).abs().max())
                / sphere_integral(float(s[0])),
            }
        )
    return cosine_rows, half_rows


def specular() -> list[dict]:
    """Relative L1 error over lamps about the mirror direction, views of 0, 40, 70 degrees, light of 2, 20, 200; F =
    1."""
    out = []
    for roughness in (0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0):
        sums = dict.fromkeys(("paper as printed", "paper with V", "ours"), 0.0)
        total = 0.0
        for angle in (0.0, 40.0, 70.0):
            for sharpness in (2.0, 20.0, 200.0):
                for tilt in (-20.0, 0.0, 10.0):
                    view, lights = direction(angle), light(direction(max(angle + tilt, 0.0), 180.0), sharpness)
                    exact = float(
                        reflected(view, torch.ones(3), roughness, 1.0, lights, "paper", rings=192, spokes=192)[1][0]
                    )
                    ours = float(
                        shade_parts(
                            N, view, torch.ones(3), torch.tensor(roughness), torch.tensor(1.0), lights, "paper"
                        )[1][0]
                    )
                    got = {
                        "paper as printed": literal_specular(view, roughness, lights, False),
                        "paper with V": literal_specular(view, roughness, lights, True),
                        "ours": ours,
                    }
                    # Each lamp counts alike, whatever its sharpness makes of its power.
                    scale = float(sg.integral(lights.sharpness[0]))
                    total += exact / scale
                    for name, value in got.items():
                        sums[name] += abs(value - exact) / scale
        out.append({"roughness": roughness, **{name: value / total for name, value in sums.items()}})
    return out


def table(rows: list[dict]) -> str:
    heads = list(rows[0])
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    lines += [
        "| " + " | ".join(f"{row[h]:g}" if i == 0 else f"{row[h]:.2g}" for i, h in enumerate(heads)) + " |"
        for row in rows
    ]
    return "\n".join(lines)


def draw(path: Path, record: dict) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 4, figsize=(18, 4))
    for axis, (name, rows) in zip(
        axes, [(n, record[n]) for n in ("evaluation", "product", "cosine", "specular")], strict=True
    ):
        heads = [h for h in rows[0] if "least" not in h]
        for form in heads[1:]:
            axis.plot([r[heads[0]] for r in rows], [max(r[form], 1e-10) for r in rows], marker="o", label=form)
        axis.set(title=name, xlabel=heads[0], xscale="log", yscale="log")
        axis.grid(alpha=0.3)
        axis.legend()
    axes[0].set_ylabel("error")
    figure.tight_layout()
    figure.savefig(path, dpi=80)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", type=Path, default=Path("docs/benchmarks"), help="folder of the report")
    folder = parser.parse_args().o
    torch.set_num_threads(1)
    cosine, hemisphere = integrals()
    record = {
        "evaluation": evaluation(),
        "product": product(),
        "cosine": cosine,
        "hemisphere": hemisphere,
        "specular": specular(),
    }
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "numerics.json").write_text(json.dumps(record, indent=1) + "\n")
    draw(folder / "numerics.png", record)
    headings = {"evaluation": evaluation, "product": product, "specular": specular}
    text = [
        "# What the stable forms buy",
        "",
        "Made by `python -m benchmarks.relight.numerics`: float32 against float64. Plot: [numerics.png](numerics.png).",
        "",
    ]
    text += ["## Evaluation of a lobe", "", f"{headings['evaluation'].__doc__}", "", table(record["evaluation"]), ""]
    text += ["## Product of two lobes", "", f"{headings['product'].__doc__}", "", table(record["product"]), ""]
    text += ["## Lobe times clamped cosine", "", f"{integrals.__doc__}", "", table(cosine), "", table(hemisphere), ""]
    text += ["## Specular lobe", "", f"{specular.__doc__}", "", table(record["specular"]), ""]
    (folder / "numerics.md").write_text("\n".join(text))


if __name__ == "__main__":
    main()
