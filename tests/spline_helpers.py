"""The schemes of high order in plain NumPy, as dense matrices built straight from the definitions.

Nothing here uses the package. Particles p, nodes i of a periodic grid of spacing h_a, B-splines of degree k centred on
nodes, N the cardinal B-spline of knots 0, 1, ..., k + 1 by the recursion of Cox and de Boor:

    φ_i(x) = Π_a Σ_images N(x_a/h_a - i_a + (k + 1)/2),    Φ_pi = φ_i(x_p),    D^a_pi = ∂φ_i/∂x_a (x_p),
    d = ΦᵀV1,    S = diag(d)⁻¹ ΦᵀV,    G = ΦᵀVΦ,    C^a = ΦᵀVD^a,    V = diag(V_p) (1 but where weights are given).

Particles less than 1e-10 cells to the left of a node count as on it; where slopes or their derivatives jump, those of
the right-hand side hold. Nodes are numbered as an array of shape `cells` in C order: the last axis runs fastest.

Every step is linear, so a scheme is a few matrices. Of a state y (its fields one after the other) the rates are L y; an
integrator is given by the state ȳ whose rates, times dt, make the step. In the short form y are nodal fields, and
particles gain dt times the particle rates of ȳ; in the particle form y are the particles themselves.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from functools import reduce
from math import prod

import numpy as np

from dense_helpers import tensor

ON_BREAK = 1e-10
DEGREES = {"linear": 1, "quadratic": 2, "cubic": 3}


def cardinal(degree, t, piece):
    """N at t, by the polynomial that holds on [piece, piece + 1]."""
    if degree == 0:
        return (piece == 0).astype(float)
    first, second = cardinal(degree - 1, t, piece), cardinal(degree - 1, t - 1.0, piece - 1)
    return (t * first + (degree + 1 - t) * second) / degree


def cardinal_slope(degree, t, piece):
    """Its derivative there."""
    return cardinal(degree - 1, t, piece) - cardinal(degree - 1, t - 1.0, piece - 1)


def spline_matrices(degree, n, h, x):
    """Values and slopes of the n periodic splines of one axis at positions x: two (particles, n) arrays."""
    coordinate = np.asarray(x, dtype=float) / h
    left = np.floor(coordinate + ON_BREAK)
    coordinate = np.maximum(coordinate, left)
    half = 0.5 * (degree + 1)
    piece = np.floor(coordinate + half + ON_BREAK)
    values, slopes = np.zeros((2, len(coordinate), n))
    rows = np.arange(len(coordinate))
    for offset in range(-3, 4):
        node = left + offset
        where = rows, np.mod(node, n).astype(int)
        values[where] += cardinal(degree, coordinate - node + half, piece - node)
        slopes[where] += cardinal_slope(degree, coordinate - node + half, piece - node) / h
    return values, slopes


def shift(n, by):
    """The matrix that takes (v_i) to (v_{i + by}), periodic."""
    return np.roll(np.eye(n), by, axis=1)


def along(axis, matrix, cells):
    """`matrix` on one axis of a grid, the identity on the others."""
    return reduce(np.kron, [matrix if a == axis else np.eye(n) for a, n in enumerate(cells)])


def difference_weights(order):
    """Weights of v_{i+j}, j = -order/2 ... order/2: the slope at 0 of the polynomial through these values."""
    places = list(range(-(order // 2), order // 2 + 1))
    weights = []
    for j in places:
        others = [i for i in places if i != j]
        slope = sum(prod(-i for i in others if i != k) for k in others)
        weights.append(float(Fraction(slope, prod(j - i for i in others))))
    return dict(zip(places, weights))


def central_difference(cells, length, order):
    """∂_a as matrices, one an axis."""
    weights = difference_weights(order)
    return [
        along(a, sum(w * shift(n, j) for j, w in weights.items()) * n / box, cells)
        for a, (n, box) in enumerate(zip(cells, length))
    ]


def low_pass(cells, order, strengths):
    """H = Π_a (1 - σ_a s_a^p): s is the second difference with the symbol sin²(θ/2)."""
    result = np.eye(int(np.prod(cells)))
    for a, (n, strength) in enumerate(zip(cells, strengths)):
        second = (2.0 * np.eye(n) - shift(n, 1) - shift(n, -1)) / 4.0
        result = result @ along(a, np.eye(n) - strength * np.linalg.matrix_power(second, order), cells)
    return result


def roughness(cells, order):
    """Σ_a Δᵀ Δ / 4^s, Δ the s-th difference along an axis."""
    total = np.zeros((int(np.prod(cells)),) * 2)
    for a, n in enumerate(cells):
        rough = along(a, np.linalg.matrix_power(shift(n, 1) - np.eye(n), order), cells)
        total += rough.T @ rough / 4.0**order
    return total


@dataclass(frozen=True)
class Scheme:
    """The names of a scheme's parts, as in a scene."""

    basis: str = "linear"
    mass: str = "lumped"
    gradient: str = "direct"
    filter: str = "local"
    integrator: str = "symplectic"
    damping: int = 0
    gradient_order: int = 4
    filter_order: int = 2
    penalty: float = 0.1
    penalty_order: int = 4
    strength: float = 1.0
    null_space: float = 0.0


class Splines:
    """Φ, D^a, d, S, G and C^a at positions (n, d) in the box, of particles that count 1 each or have weights (n,)."""

    def __init__(self, basis, cells, length, position, weight=None):
        self.cells, self.length = tuple(cells), tuple(length)
        position = np.asarray(position, dtype=float).reshape(-1, len(cells))
        degree = DEGREES[basis]
        axes = [spline_matrices(degree, n, box / n, x) for n, box, x in zip(cells, length, position.T)]
        self.phi = tensor([values for values, _ in axes])
        self.D = [tensor([axis[int(b == a)] for b, axis in enumerate(axes)]) for a in range(len(cells))]
        self.weight = np.ones(len(position)) if weight is None else np.asarray(weight, dtype=float)
        self.transposed = self.phi.T * self.weight
        self.d = self.transposed.sum(axis=1)
        self.seen = self.d > 0
        self.inverse_d = np.zeros(len(self.d))
        self.inverse_d[self.seen] = 1.0 / self.d[self.seen]
        self.S = self.inverse_d[:, None] * self.transposed
        self.G = self.transposed @ self.phi
        self.C = [self.transposed @ D for D in self.D]

    def inverse_gram(self):
        """G⁺, singular values of V^½ Φ below 1e-10 of the largest cut."""
        _, s, vt = np.linalg.svd(np.sqrt(self.weight)[:, None] * self.phi, full_matrices=False)
        kept = s > 1e-10 * s[0]
        return (vt[kept].T / s[kept] ** 2) @ vt[kept]

    def mass(self, scheme):
        """Particle values to nodal fields, (m, n)."""
        if scheme.mass == "lumped":
            return self.S
        if scheme.mass == "consistent":
            return self.inverse_gram() @ self.transposed
        mean = self.d.sum() / len(self.d)
        penalty = scheme.penalty * mean * roughness(self.cells, scheme.penalty_order)
        return np.linalg.solve(self.G + penalty, self.transposed)

    def nodal_filter(self, scheme):
        """N, with F = Φ N ΦᵀV the filter of particle values, (m, m)."""
        if scheme.filter in ("exact", "svd"):
            return self.inverse_gram()
        smooth = self.S @ self.phi
        return self._series(scheme)(smooth) * self.inverse_d

    def _series(self, scheme):
        """p as a function of a matrix, p(λ) = (1 - e(λ)) / λ with the error e of the truncated series."""
        keeps = np.polynomial.Polynomial([1.0, -1.0])
        if scheme.filter == "local":
            error = keeps
        elif scheme.filter == "order":
            error = keeps**scheme.filter_order
        else:
            low = 3.0 ** -len(self.cells)
            to_interval = np.polynomial.Polynomial([1.0 + low, -2.0]) / (1.0 - low)
            chebyshev = np.polynomial.Polynomial(
                np.polynomial.chebyshev.cheb2poly([0.0] * (scheme.filter_order - 1) + [1.0])
            )(to_interval)
            error = keeps * chebyshev / chebyshev(0.0)
        p = (1.0 - error).coef[1:]
        return lambda matrix: sum(c * np.linalg.matrix_power(matrix, j) for j, c in enumerate(p))

    def particle_slopes(self, scheme):
        """Per axis what nodal fields make particles gain, before signs and factors, (n, m) each."""
        if scheme.gradient == "grid":
            differences = central_difference(self.cells, self.length, scheme.gradient_order)
            if scheme.filter in ("none", "exact", "svd"):
                return [self.phi @ difference for difference in differences]
            return [self.phi @ self.nodal_filter(scheme) @ self.G @ difference for difference in differences]
        if scheme.filter == "none":
            return self.D
        keep = self.phi @ self.nodal_filter(scheme)
        if scheme.gradient == "skew":
            return [keep @ (0.5 * (C - C.T)) for C in self.C]
        return [keep @ C for C in self.C]

    def field_slopes(self, scheme):
        """The same for what the nodal fields themselves gain: their response to it, (m, m) each."""
        if scheme.mass == "lumped" or (scheme.gradient == "direct" and scheme.filter == "none"):
            mass = self.mass(scheme)
            return [mass @ slope for slope in self.particle_slopes(scheme)]
        if scheme.gradient == "grid":
            differences = central_difference(self.cells, self.length, scheme.gradient_order)
            if scheme.filter in ("none", "exact", "svd"):
                return differences
            return [self.nodal_filter(scheme) @ self.G @ difference for difference in differences]
        N = self.nodal_filter(scheme)
        if scheme.gradient == "skew":
            return [N @ (0.5 * (C - C.T)) for C in self.C]
        return [N @ C for C in self.C]


def rates(slopes, density, stiffness):
    """[[0, -ρ₀ Σ_a K_a], [-(c²/ρ₀) K_a, 0]]: the operator of the slopes K_a (r, c) each, ((1 + d) r, (1 + d) c)."""
    dim, (r, c) = len(slopes), slopes[0].shape
    result = np.zeros(((1 + dim) * r, (1 + dim) * c))
    for a, slope in enumerate(slopes, start=1):
        result[:r, a * c : (a + 1) * c] = -density * slope
        result[a * r : (a + 1) * r, :c] = -stiffness * slope
    return result


def mean_state(integrator, L, y, dt, dim):
    """ȳ with y(t + dt) = y + dt L ȳ."""
    if integrator == "symplectic":
        first = len(y) // (1 + dim)
        mean = y.copy()
        mean[:first] += dt * (L @ y)[:first]
        return mean
    if integrator == "rk4":
        second = y + 0.5 * dt * (L @ y)
        third = y + 0.5 * dt * (L @ second)
        fourth = y + dt * (L @ third)
        return (y + 2.0 * second + 2.0 * third + fourth) / 6.0
    assert integrator == "midpoint"
    return np.linalg.solve(np.eye(len(y)) - 0.5 * dt * L, y)


def on_all(matrix, columns):
    """`matrix` applied to every field of a stacked state."""
    return np.kron(np.eye(columns), matrix)


@dataclass(frozen=True)
class Gas:
    """ρ₀, c and the flow v."""

    density: float
    sound_speed: float
    flow: tuple[float, ...]

    @property
    def stiffness(self):
        return self.sound_speed**2 / self.density


def damping_matrix(splines, scheme, gas, dt):
    """H - 1, or None."""
    if not scheme.damping:
        return None
    spacing = np.array(splines.length) / np.array(splines.cells)
    strengths = np.minimum(1.0, scheme.strength * gas.sound_speed * dt / spacing)
    return low_pass(splines.cells, scheme.damping, strengths) - np.eye(len(splines.d))


def unseen(splines, scheme, gas, dt, state):
    """What particle values lose of what their nodal fields do not hold."""
    spacing = np.array(splines.length) / np.array(splines.cells)
    share = min(1.0, scheme.null_space * gas.sound_speed * dt / spacing.min())
    return share * (state - splines.phi @ splines.mass(scheme) @ state)


def short_step(splines, scheme, gas, dt, state):
    """State (n, 1 + d) after one step with frozen positions, by nodal fields."""
    dim, columns = len(splines.cells), state.shape[1]
    mass = splines.mass(scheme)
    y = (mass @ state).T.ravel()
    of_fields = rates(splines.field_slopes(scheme), gas.density, gas.stiffness)
    of_particles = rates(splines.particle_slopes(scheme), gas.density, gas.stiffness)
    mean = mean_state(scheme.integrator, of_fields, y, dt, dim)
    change = dt * (of_particles @ mean).reshape(columns, -1).T
    damping = damping_matrix(splines, scheme, gas, dt)
    if damping is not None:
        end = (y + dt * (of_fields @ mean)).reshape(columns, -1).T
        change = change + splines.phi @ damping @ end
    return state + change - unseen(splines, scheme, gas, dt, state)


def particle_step(splines, scheme, gas, dt, state):
    """The same by particle values alone: each rate maps to the nodes, takes slopes and filters."""
    dim, columns = len(splines.cells), state.shape[1]
    mass = splines.mass(scheme)
    L = rates([slope @ mass for slope in splines.particle_slopes(scheme)], gas.density, gas.stiffness)
    q = state.T.ravel()
    end = q + dt * (L @ mean_state(scheme.integrator, L, q, dt, dim))
    damping = damping_matrix(splines, scheme, gas, dt)
    if damping is not None:
        end = end + on_all(splines.phi @ damping @ mass, columns) @ end
    return end.reshape(columns, -1).T - unseen(splines, scheme, gas, dt, state)


def run_steps(step, scheme, gas, dt, cells, length, position, state, steps):
    """Position and state (n, 1 + d) after that many steps of `short_step` or `particle_step`, and motion."""
    for _ in range(steps):
        state = step(Splines(scheme.basis, cells, length, position), scheme, gas, dt, state)
        position = np.mod(position + np.array(gas.flow) * dt, length)
    return position, state
