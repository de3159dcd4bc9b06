"""How much better than the linear column of ``equal_margins.py`` an independent designer is.

    python benchmarks/independent_linear.py [--generations 150] [--loads sinusoid,steps,noise]

Differential evolution (Storn & Price, *Journal of Global Optimization* 11, 1997) over the poles of
law and observer, with one to three integrators, for each class of load, under M_s ≤ 2 and
M_ks ≤ 100, then Nelder and Mead. Model, responses and bounds are its own, nothing is of quell.
The cost is the RMS of y under the spectrum of the load, which ``tune`` has as its objective, too.
"""

from __future__ import annotations

import math
import warnings

import equal_margins
import numpy as np
from measured import options_of, parser_of, write
from scipy.linalg import expm
from scipy.optimize import differential_evolution, minimize

from quell.controllers.linear import LinearController, LinearLaw

DT, M_S, M_KS, DAMPING = equal_margins.DT, equal_margins.M_S, 100.0, 0.3


class FreePoles:
    """Controllers by the poles of their law and of an observer of w, w', … (``integrators``).

    ``u = −K x̂ − ŵ`` with a predictor of the plant and the load, sampled exactly.
    """

    def __init__(self, plant: str, integrators: int) -> None:
        b, a = equal_margins.MACHINES[plant]
        n, e = len(a), integrators
        self.order, self.size = n, n + e
        A = np.diag(np.ones(n + e - 1), 1)
        A[n - 1, :n] = -np.array(a)
        A[n - 1, n] = b
        B = np.zeros((n + e, 1))
        B[n - 1] = b
        whole = expm(DT * np.block([[A, B], [np.zeros((1, n + e + 1))]]))
        self.F, self.G = whole[:-1, :-1], whole[:-1, -1]
        self.P, self.g = self.F[:n, :n], self.G[:n]
        self.c = np.eye(n + e)[0]
        # In units of the sample time nothing is a small difference of large numbers.
        self.unit = DT ** np.arange(n + float(e))
        self.scaled = self.F * self.unit[:, None] / self.unit
        rows = [self.c @ self.scaled]
        for _ in range(n + e - 1):
            rows.append(rows[-1] @ (self.scaled - np.eye(n + e)))
        self.last = np.linalg.solve(np.array(rows), np.eye(n + e)[-1])
        columns = [np.linalg.matrix_power(self.P, i) @ self.g for i in range(n)]
        self.first = np.linalg.solve(np.array(columns), np.eye(n)[-1])
        self.omega = np.geomspace(5e-3, 0.9999 * np.pi / DT, 400)
        self.of_plant = self.plant_at(self.omega)
        kinds = [[1, 2] * (size // 2) + [1] * (size % 2) for size in (n, n + e)]
        self.is_damping = np.array(kinds[0] + kinds[1]) == 2
        self.bounds = [(DAMPING, 3.0) if each else (-1.0, 8.3) for each in self.is_damping]

    def plant_at(self, omega: np.ndarray) -> np.ndarray:
        """Return the frequency response of the sampled plant."""
        z = np.exp(1j * omega * DT)[:, None, None]
        given = np.broadcast_to(self.g[:, None], (omega.size, self.order, 1))
        return np.linalg.solve(z * np.eye(self.order) - self.P, given)[:, 0, 0]

    def gains(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return K and L for (log ω, damping) of pairs, and log of single poles."""
        at, products = 0, []
        for M in (self.P, self.scaled):
            product, left = np.eye(len(M)), len(M)
            while left > 1:
                omega, damping = np.exp(x[at]), x[at + 1]
                pair = np.exp(DT * np.roots([1.0, 2.0 * damping * omega, omega**2]))
                rest = np.sum(pair).real * M - np.prod(pair).real * np.eye(len(M))
                product, at, left = product @ (M @ M - rest), at + 2, left - 2
            if left:
                product = product @ (M - np.exp(-DT * np.exp(x[at])) * np.eye(len(M)))
                at += 1
            products.append(product)
        K = np.zeros(self.size)
        K[: self.order], K[self.order] = self.first @ products[0], 1.0
        return K, products[1] @ self.last / self.unit

    def feedback(self, x: np.ndarray, omega: np.ndarray) -> np.ndarray:
        """Return the frequency response of the controller, from −y to u."""
        K, L = self.gains(x)
        M = (np.eye(K.size) - np.outer(L, self.c)) @ (self.F - np.outer(self.G, K))
        z = np.exp(1j * omega * DT)[:, None, None]
        return np.linalg.solve(z * np.eye(K.size) - M, z * L[:, None])[..., 0] @ K

    def controller(self, x: np.ndarray) -> LinearController:
        """Return the controller of the error r − y."""
        K, L = self.gains(x)
        W = np.eye(K.size) - np.outer(L, self.c)
        law = LinearLaw(
            self.F @ W, -self.F @ L, self.F @ L, self.G, -K @ W, float(K @ L), float(-K @ L)
        )
        return LinearController(law, DT)

    def cost(self, x: np.ndarray, omega: np.ndarray, power: np.ndarray) -> float:
        """Return the logarithm of the RMS of y, and 100 times what the bounds are exceeded by."""
        inside = np.clip(x, *np.array(self.bounds).T)
        with np.errstate(all="ignore"):
            try:
                found = self.feedback(inside, np.concatenate([self.omega, omega]))
            except np.linalg.LinAlgError:
                return 1e3
            C, of_load = np.split(found, [self.omega.size])
            S = 1.0 / (1.0 + self.of_plant * C)
            plant = self.plant_at(omega)
            left = np.abs(plant / (1.0 + plant * of_load)) ** 2
            value = 0.5 * np.log(np.sum(power * left))
        over = max(np.max(np.abs(S)) / M_S - 1.0, 0.0)
        over += max(np.max(np.abs(C * S)) / M_KS - 1.0, 0.0)
        value += 100.0 * min(over, 10.0) + 10.0 * np.sum(np.abs(x - inside))
        return float(value) if np.isfinite(value) else 1e3

    def best(self, omega: np.ndarray, power: np.ndarray, generations: int) -> np.ndarray:
        """Return the parameters that leave least."""
        how = {"args": (omega, power), "popsize": 12, "seed": 2, "tol": 1e-8, "polish": False}
        x = differential_evolution(self.cost, self.bounds, maxiter=generations, **how).x
        near = {"maxfev": 20 * generations, "adaptive": True, "xatol": 1e-5, "fatol": 1e-6}
        end = minimize(self.cost, x, args=(omega, power), method="Nelder-Mead", options=near)
        return np.clip(end.x, *np.array(self.bounds).T)


def main() -> None:
    """Print what the independent designer and ``tune`` leave of each load."""
    parser = parser_of(__doc__)
    parser.add_argument("--generations", type=int, default=150)
    parser.add_argument("--loads", default="sinusoid,cogging,spring,steps,noise")
    given = options_of(parser, generations=2, loads="steps")
    warnings.simplefilter("ignore")
    machine = equal_margins.Machine("axis", M_KS, 2.0 if given.quick else equal_margins.LAST)
    figures: dict[str, dict[str, float]] = {}
    for load in given.loads.split(","):
        known = equal_margins.spectrum(load, *machine.case(load, equal_margins.TUNING_SEEDS[0]))
        row = figures[load] = {}
        for integrators in (1,) if given.quick else (1, 2, 3):
            designer = FreePoles("axis", integrators)
            x = designer.best(known.omega, known.power, given.generations)
            row[f"{integrators} integrators"] = math.exp(designer.cost(x, known.omega, known.power))
        best = min(row.values())
        structures = ("bandwidths",) if given.quick else equal_margins.CLASSES[load].structures
        for structure in structures:
            tuned = machine.linear_for(structure, load, known)
            row[structure] = tuned.design.objective
        own = min(row[structure] for structure in structures)
        row["tune over the independent designer"] = own / best
        print(load, {key: f"{value:.3g}" for key, value in row.items()}, flush=True)
    write(given, figures)


if __name__ == "__main__":
    main()
