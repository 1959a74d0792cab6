"""Claims of the paper, each with the numbers that decide it and a verdict that follows from them by a rule."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mpipic.arrays import FloatArray
from mpipic.figures import gradients
from mpipic.figures.costs import Cost, exponent
from mpipic.figures.plan import Growth
from mpipic.figures.waves import rms

CONFIRMED, LIMITED, CONTRADICTED = "confirmed", "confirmed with a limit", "contradicted"
ROUNDING = 1e-8
"""Shares and errors below are taken for zero: solvers and sums round."""
GROWS = 1e-9
"""Growth per step above which a scheme grows; eigenvalues are no more accurate."""


@dataclass(frozen=True)
class Claim:
    """A statement of the paper.

    Attributes
    ----------
    where
        Section or equation.
    quote
        The paper's words.
    numbers
        What decides, name to value in words.
    verdict
        Confirmed, confirmed with a limit, or contradicted.
    rule
        How the verdict follows from the numbers.
    remark
        More that the numbers say.
    figure
        Number of the figure that shows it, 0 for none.
    """

    where: str
    quote: str
    numbers: Mapping[str, str]
    verdict: str
    rule: str
    remark: str = ""
    figure: int = 0


def verdict(holds: bool, whole: bool = True) -> str:
    """Return the verdict on a claim that holds or not, as a whole or within a limit."""
    return (CONFIRMED if whole else LIMITED) if holds else CONTRADICTED


def pairs(columns: Mapping[str, FloatArray], h: float) -> Claim:
    """Judge whether gradients come in pairs: equal within a cell."""
    spread = gradients.spread_in_cells(columns["x"], columns["computed"], h)
    return Claim(
        "section 2.2, figure 1",
        "The pairing of point values is due to the piecewise constant derivative of the linear basis functions.",
        {
            "largest difference within a cell / largest gradient": number(spread),
            "error of the computed gradient (root mean square)": number(rms(columns["computed"] - columns["true"])),
        },
        verdict(spread <= ROUNDING),
        f"confirmed if no two particles of a cell differ by more than {ROUNDING:g}",
        figure=1,
    )


def oscillation(columns: Mapping[str, FloatArray]) -> Claim:
    """Judge whether null-space values are oscillatory: most neighbours have opposite signs."""
    changes = gradients.sign_changes(columns["null_space"])
    return Claim(
        "abstract, figure 2",
        "Given positive mapping weights such null space values are oscillatory in nature.",
        {"neighbours of opposite sign": percent(changes)},
        verdict(changes > 0.5, changes > 0.9),
        "confirmed above 90 % (noise without any order has 50 %), with a limit above 50 %",
        figure=2,
    )


def reintroduction(columns: Mapping[str, FloatArray]) -> Claim:
    """Judge whether the gradient at the particles has a null-space part."""
    part = gradients.share(columns["null_space"], columns["computed"])
    return Claim(
        "section 3.1, figure 2",
        "It is at the next step in the computation, equation 12, that a nullspace component can be re-introduced.",
        {"null-space share of the computed gradient": percent(part)},
        verdict(part > ROUNDING),
        f"confirmed if the share is above {ROUNDING:g}",
        figure=2,
    )


def removal(before: float, after: float, errors: tuple[float, float]) -> Claim:
    """Judge whether the svd removes the null space: a share before, and none after."""
    return Claim(
        "section 3.1, figure 3",
        "Once the nullspace component is known, it can be removed from the computed gradient, to get a smoothed "
        "version of dg.",
        {
            "null-space share before": percent(before),
            "null-space share after": number(after),
            "error before, after (root mean square)": f"{number(errors[0])}, {number(errors[1])}",
        },
        verdict(before > ROUNDING and after <= ROUNDING, errors[1] < errors[0]),
        f"confirmed if a share above {ROUNDING:g} falls below it and the error falls too; with a limit if it does not",
        figure=3,
    )


def local_filter(errors: Mapping[str, float]) -> Claim:
    """Judge whether the local filter smooths the gradient: less error than without."""
    return Claim(
        "section 3.2.1, figure 4",
        "there is no longer a need to explicitly calculate the nullspace in order to smooth out the particle gradients",
        {f"error, {name} (root mean square)": number(error) for name, error in errors.items()},
        verdict(errors["local"] < errors["computed"], errors["local"] <= errors["svd"]),
        "confirmed if the local filter has the least error; with a limit if only less than no filter",
        "The local filter damps waves that nodes see, which the svd does not.",
        figure=4,
    )


def interpolation(share: float) -> Claim:
    """Judge whether interpolation puts noise into the null space."""
    return Claim(
        "section 3.2.1",
        "While there is no nullspace component at the nodes, there is nothing to prevent nullspace noise from being "
        "introduced at the particle via the interpolation process.",
        {"null-space share of the interpolated values": number(share)},
        verdict(share > ROUNDING),
        f"confirmed if the share is above {ROUNDING:g}",
        "Interpolated values Φa lie in the range of Φ, the row space of S, so they have no part in its null space, on "
        "any particles. It is the gradient that brings noise.",
        figure=4,
    )


def noise_at(step: int, errors: Mapping[str, float], figure: int) -> Claim:
    """Judge whether the unfiltered method shows noise: three times the error of the svd."""
    return Claim(
        f"section 3.4, figure {figure}",
        f"at time step {step}, the method without the nullspace filter is showing the results of the numerical "
        "nullspace noise",
        {f"error, {name}": number(error) for name, error in errors.items()},
        verdict(errors["unfiltered"] > 3.0 * errors["svd"]),
        "confirmed if the error without filter is three times that of the svd",
        "The noise grows from rounding: its size at this step differs between machines.",
        figure=figure,
    )


def still_stable(step: int, peaks: Mapping[str, float], figure: int) -> Claim:
    """Judge whether filters hold where none has failed: |ρ| against its start, 1."""
    held = all(peaks[name] <= 1.1 for name in peaks if name != "unfiltered")
    return Claim(
        f"section 3.4, figure {figure}",
        f"the method with the nullspace filter is still stable at {step} steps even though the original method is "
        "clearly unstable",
        {f"largest |ρ| / its start, {name}": number(peak) for name, peak in peaks.items()},
        verdict(held and peaks["unfiltered"] > 2.0),
        "confirmed if |ρ| passes twice its start without a filter, and not 1.1 times with either",
        figure=figure,
    )


def local_stability(peak: float, growth: Growth, failed: int | None, step: int, long_steps: int) -> Claim:
    """Judge whether the local filter is stable: bounded at the step, and for good only if nothing grows."""
    numbers = {
        f"largest |ρ| / its start at step {step}": number(peak),
        "growth per step (μ - 1)": number(growth.growth_per_step),
        "noise of 1e-16 reaches the solution's size at step": count(growth.noise_step),
        "and ends the run at step": count(growth.blow_up_step),
    }
    if long_steps:
        numbers["measured by --long: the run ends at step"] = f"{failed:,}" if failed else f"not within {long_steps:,}"
    return Claim(
        "section 3.4, figure 8",
        "if the calculation is continued out too 5000 steps the solution obtained with the local filter remains stable",
        numbers,
        verdict(peak <= 1.1, growth.growth_per_step <= GROWS),
        f"confirmed if |ρ| stays below 1.1 times its start; with a limit if growth per step is above {GROWS:g}",
        "Growth is computed from the scheme (Floquet), not watched. Rounding seeds the growing mode with less than "
        "1e-16 where the lattice is symmetric, so a run outlasts the prediction by up to a half.",
        figure=8,
    )


def svd_fails(peak: float, growth: Growth | None, step: int) -> Claim:
    """Judge whether the svd-filtered solution becomes unstable."""
    return Claim(
        "section 3.4, figure 8",
        "but the SVD filtered solution does finally become unstable",
        {
            f"largest |ρ| / its start at step {step}": number(peak),
            "growth per step (μ - 1), computed with exact": number(growth.growth_per_step) if growth else "not found",
        },
        verdict(peak > 2.0),
        "confirmed if |ρ| passes twice its start",
        figure=8,
    )


def improved_stability(growth: Mapping[str, Growth]) -> Claim:
    """Judge whether filters improve stability: less growth per step; for good only if there is none."""
    found = {name: one.growth_per_step for name, one in growth.items()}
    filtered = [value for name, value in found.items() if name != "unfiltered"]
    return Claim(
        "section 4",
        "The removal of the nullspace error from the PIC method used has resulted in much improved stability.",
        {
            f"growth per step, {name}": f"{number(value)}, noise as large as the solution at step "
            f"{count(growth[name].noise_step)}"
            for name, value in found.items()
        },
        verdict(max(filtered) < 0.5 * found["unfiltered"], max(filtered) <= GROWS),
        f"confirmed if filters halve the growth at least; with a limit if any still grows by more than {GROWS:g}",
        "The svd's is that of exact, the same operator to a relative residual of 1e-10. Filters delay the blow-up.",
        figure=7,
    )


def cost(measured: Sequence[Cost]) -> Claim:
    """Judge whether the svd costs as it says and a local filter far less."""
    powers = {kind: exponent(measured, kind) for kind in ("svd", "exact", "local")}
    largest = {kind: max((c for c in measured if c.filter == kind), key=lambda c: c.nodes) for kind in powers}
    return Claim(
        "section 3.2",
        "the computational complexity of generating the matrix V with a singular value decomposition is O(m²n + n³)",
        {
            f"{kind}: seconds ~ m^p, p": f"{powers[kind]:.2f} ({largest[kind].seconds:.2g} s on {largest[kind].nodes:,}"
            " nodes)"
            for kind in powers
        },
        verdict(powers["svd"] > 1.5 > powers["local"], 2.5 <= powers["svd"] <= 3.5),
        "confirmed if p of the svd is 2.5 to 3.5, and the local filter's below 1.5; with a limit if only above 1.5",
        "n = 2m particles, so m²n + n³ is m³ in the limit; only the part V_r is computed here. exact is the svd's "
        "operator by a Krylov solve.",
    )


def misprint(errors: Mapping[str, float]) -> Claim:
    """Judge eq. 7 as printed: it solves the equations if its error is rounding."""
    return Claim(
        "equation 7",
        "ρ₁(x, t) = ½ (f(x - (c - u₀)t) + f(x + (c - u₀)t))",
        {f"error of the {name} formula (root mean square)": number(error) for name, error in errors.items()},
        verdict(errors["printed"] <= ROUNDING),
        f"confirmed if the error as printed is below {ROUNDING:g}",
        "A misprint: the wave that runs with the flow moves at c + u₀, so the first term is f(x - (c + u₀)t).",
    )


def number(value: float) -> str:
    """Return a number as tables show it."""
    return f"{value:.3g}" if np.isfinite(value) else "not finite"


def percent(value: float) -> str:
    """Return a share as tables show it."""
    return f"{100.0 * value:.3g} %"


def count(value: float | None) -> str:
    """Return a number of steps as tables show it."""
    return "never" if value is None else f"{value:,.0f}"
