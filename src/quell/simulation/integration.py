"""Check of a plant's numerical integration along a run, by step doubling.

From some recorded samples the plant is integrated over one sample with its sub-steps and with twice
as many. Of a method of order 4 the difference is 15/16 of the error (Hairer, Nørsett & Wanner,
*Solving Ordinary Differential Equations I*, II.4). Plants that are solved exactly are not checked.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np

from quell.kernels.dispatch import call_specialised, compiled, interpreted
from quell.plants.base import advance, as_input
from quell.plants.channels import EncodedOutputsModel
from quell.plants.friction import FrictionModel
from quell.plants.linear import DelayedPlantModel, EncodedPlantModel
from quell.plants.nonlinear import (
    CompiledNonlinear,
    CompiledOfMany,
    CompiledParametric,
    PythonNonlinear,
    PythonOfMany,
    refined,
)
from quell.types import Matrix, Vector

# Largest error of a state in a sample, as a share of the state's largest value. A linear mode
# reaches it where h |λ| is about 1; stiff friction that is integrated well has 1e-4, and one that
# is not resolved 0.1 and more. Chosen by hand.
LARGEST_ERROR = 0.01
# Samples that are checked in a segment: spread over it, and where the states turn most sharply.
_SPREAD, _SHARPEST = 16, 16
# Most doublings of the sub-steps that are tried for advice.
_MOST_DOUBLINGS = 10
_WRAPPERS = (EncodedPlantModel, DelayedPlantModel, EncodedOutputsModel)


class Samples(NamedTuple):
    """Samples of a run, from which the plant is integrated over one sample."""

    t: Vector  # [s] (k,)
    u: Matrix  # (k, m)
    w: Matrix  # (k, q)
    x: Matrix  # (k, n)


@compiled
def step_differences(
    coarse: Any,
    fine: Any,
    t: Vector,
    u: Matrix,
    w: Matrix,
    x: Matrix,
    scratch: Vector,
    after: Matrix,
    difference: Matrix,
) -> None:
    """Write the states after a sample, and what ``coarse`` and ``fine`` differ by, (k, n) each."""
    for k in range(t.size):
        for j in range(x.shape[1]):
            after[k, j] = x[k, j]
            difference[k, j] = x[k, j]
        acting = as_input(coarse, u[k])
        advance(coarse, difference[k], scratch, t[k], acting, w[k])
        advance(fine, after[k], scratch, t[k], acting, w[k])
        for j in range(x.shape[1]):
            difference[k, j] -= after[k, j]


class IntegrationCheck:
    """The check of one run.

    ``error`` is the largest so far, as a share of the state's range; ``enough`` is a number of
    sub-steps with which it is small, zero if none was found.
    """

    def __init__(self, model: Any, as_python: bool) -> None:
        self._size = self._delay = 0
        while isinstance(model, _WRAPPERS):
            if isinstance(model, DelayedPlantModel):
                self._size, self._delay = model.size, 1
            model = model.inner
        several = CompiledOfMany | PythonOfMany
        kinds = CompiledNonlinear | CompiledParametric | PythonNonlinear | FrictionModel | several
        self.needed = isinstance(model, kinds)
        self.model, self.error, self.enough = model, 0.0, 0
        self._step_differences = (
            interpreted(step_differences)
            if as_python
            else partial(call_specialised, step_differences)
        )

    def acquit(self) -> None:
        """Forget the errors: the run diverges with enough sub-steps, too."""
        self.error = 0.0

    @property
    def poor(self) -> bool:
        """True if there were too few sub-steps."""
        return self.error > LARGEST_ERROR

    def add(self, samples: Samples, all_of_them: bool) -> None:
        """Check samples of a segment, some or all of them."""
        if not samples.t.size:
            return
        t, u, w, x = samples
        finite = np.all(np.isfinite(x), axis=1)
        if not np.all(finite):
            self.add(Samples(*(part[finite] for part in samples)), all_of_them)
            return
        if self._delay:  # the state ends with the values of u on their way, the oldest last
            u, x = x[:, -1:], x[:, : self._size]
        scale = np.max(np.abs(x), axis=0)
        chosen = slice(None) if all_of_them else chosen_samples(x, scale)
        picked = Samples(*(np.ascontiguousarray(part[chosen]) for part in (t, u, w, x)))
        errors = self._errors(self.model, picked, scale)
        error, worst = float(np.max(errors)), int(np.argmax(errors))
        if error > max(self.error, LARGEST_ERROR):
            factor = self._factor(Samples(*(part[worst : worst + 1] for part in picked)), scale)
            self.enough = factor * self.model.substeps
        self.error = max(self.error, error)

    def _factor(self, worst: Samples, scale: Vector) -> int:
        """Return how many times as many sub-steps are enough for a sample; 0 if none is found."""
        factors = (2**i for i in range(1, _MOST_DOUBLINGS + 1))
        enough = (
            factor
            for factor in factors
            if self._errors(refined(self.model, factor), worst, scale)[0] <= LARGEST_ERROR
        )
        return next(enough, 0)

    def _errors(self, model: Any, samples: Samples, scale: Vector) -> Vector:
        """Return the largest error of a state in each sample, as a share of the state's range."""
        after, difference = np.empty_like(samples.x), np.empty_like(samples.x)
        with np.errstate(all="ignore"):
            self._step_differences(
                model, refined(model, 2), *samples, np.zeros(6 * scale.size), after, difference
            )
            before = after + difference  # with the plant's own sub-steps
            range_ = np.maximum(scale, np.maximum(np.abs(after), np.abs(before)))
            share = np.abs(difference) / np.where(range_ > 0.0, range_, 1.0)
        return np.asarray(np.max(np.where(np.isfinite(share), share, 1.0), axis=1))


def chosen_samples(x: Matrix, scale: Vector) -> Any:
    """Return the indices of samples that are spread over a segment, or turn most sharply."""
    if len(x) <= _SPREAD + _SHARPEST:
        return slice(None)
    spread = np.linspace(0, len(x) - 1, _SPREAD).astype(np.int64)
    turn = np.abs(np.diff(x, 2, axis=0)) / np.where(scale > 0.0, scale, 1.0)
    sharpest = np.argpartition(np.max(turn, axis=1), -_SHARPEST)[-_SHARPEST:] + 1
    return np.unique(np.concatenate([spread, sharpest]))


def with_substeps(model: Any, substeps: int) -> Any:
    """Return the sampled plant of a check, or one that contains it, with so many sub-steps."""
    if isinstance(model, _WRAPPERS):
        return model._replace(inner=with_substeps(model.inner, substeps))
    return refined(model, substeps // model.substeps)
