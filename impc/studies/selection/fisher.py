"""Fisher information of normalised parameters, its rank, and directions it does not see.

    F = (1 / sigma^2) sum_k (dy_k/dt)' (dy_k/dt)                 (A.2), (A.6)

F^-1 bounds the covariance of any unbiased estimate (A.5). A singular F says that a combination of
parameters changes nothing: it is named here before any selection, because a selection from an
unidentifiable set only hides it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, Frozen, frozen
from impc.studies.selection.model import sensitivity

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.studies.selection.model import ParametricModel, Trial

# Singular values of the sensitivity below this, of the largest, are rounding or as good as that.
_RANK = 1e-6
_NAMED = 0.1
_UNSEEN = 1.0


@dataclass(frozen=True)
class Information(Frozen):
    """Information of all trials together."""

    F: Array  # (k, k), in normalised units
    singular_values: Array  # Of the stacked sensitivity over sigma (k,), largest first
    directions: Array  # Right singular vectors, one a row (k, k), in normalised units
    # The same for sensitivities with respect to the logarithms of the parameters, singular value
    # and direction side by side (k, 1 + k). A direction there is a scaling.
    relative: Array
    variance: float  # sigma^2 of the residual
    rank: int  # Of the relative sensitivities: singular values above 1e-6 of the largest


@dataclass(frozen=True)
class NullDirection:
    """A combination of parameters that the outputs do not see."""

    singular_value: float  # Relative to the largest
    # Parameter -> its part in the direction of relative changes, largest first
    shares: dict[str, float]
    sentence: str  # The same in words


def fisher_information(
    model: ParametricModel, theta: Array, trials: Sequence[Trial], variance: float | None = None
) -> Information:
    """Information at a point.

    `theta` (k,).
    """
    rows, squares = [], 0.0
    for trial in trials:
        outputs, derivative = sensitivity(model, theta, trial.input)
        rows.append(derivative.reshape(-1, model.size))
        squares += float(np.sum((trial.outputs - outputs) ** 2))
    table = np.concatenate(rows)
    sigma2 = squares / (len(table) - model.size) if variance is None else variance
    sigma = np.sqrt(max(sigma2, 1e-300))
    _, values, directions = np.linalg.svd(table / sigma, full_matrices=False)
    in_logarithms = table / model.gain * theta
    _, logarithmic, relative = np.linalg.svd(in_logarithms / sigma, full_matrices=False)
    rank = int(np.count_nonzero(logarithmic > _RANK * logarithmic[0]))
    return Information(
        frozen(table.T @ table / sigma2),
        frozen(values),
        frozen(directions),
        frozen(np.column_stack([logarithmic, relative])),
        float(sigma2),
        rank,
    )


def common_scaling(model: ParametricModel, found: Information, names: Sequence[str]) -> float:
    """How much scaling the parameters `names` together changes the outputs, over their noise.

    The norm over all samples of the change per logarithm of the scale, in deviations of the noise:
    below 1 nobody sees a scaling by e.
    """
    together = np.array([float(name in names) for name in model.names])
    values, vectors = found.relative[:, 0], found.relative[:, 1:]
    return float(np.linalg.norm(values * (vectors @ together)))


def unseen_scalings(model: ParametricModel, found: Information) -> tuple[tuple[str, ...], ...]:
    """Sets of parameters of one kind of unit that may be scaled together without any effect.

    Units count as one kind when they begin alike: torque gains in N m/rad, N m s/rad.
    """
    kinds: dict[str, list[str]] = {}
    for name, unit in zip(model.names, model.units, strict=True):
        kinds.setdefault(unit.split("/")[0].split(" s")[0], []).append(name)
    return tuple(
        tuple(names)
        for kind, names in kinds.items()
        if kind and len(names) > 1 and common_scaling(model, found, names) <= _UNSEEN
    )


def null_directions(model: ParametricModel, found: Information) -> tuple[NullDirection, ...]:
    """Directions beyond the rank, least seen first, in relative changes of the parameters."""
    values, vectors = found.relative[:, 0], found.relative[:, 1:]
    told = []
    for index in range(model.size - 1, found.rank - 1, -1):
        v = vectors[index] * np.sign(vectors[index][np.argmax(np.abs(vectors[index]))])
        order = np.argsort(-np.abs(v), kind="stable")
        shares = {model.names[place]: float(v[place]) for place in order if abs(v[place]) >= _NAMED}
        parts = ", ".join(f"{name} {share:+.2f}" for name, share in shares.items())
        told.append(
            NullDirection(
                float(values[index] / values[0]),
                shares,
                f"changing {parts} (relative changes) together changes the outputs by "
                f"{values[index] / values[0]:.0e} of what the best seen direction does",
            )
        )
    return tuple(told)
