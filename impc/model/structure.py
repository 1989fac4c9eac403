"""Cost structures: weights built from a few named cost weights (docs/howto/weights.md).

    Q = F' W F,   R = G' V G,     rows of F (k, n) and G (l, m) given; W, V depend on the unknowns z

Each row is a feature of the states or inputs, a linear combination by name. Without products of
features W = diag(exp(z)); a cost weight of zero is z = -inf. With products W = L L' with
L = diag(exp(z_1 .. z_k)) C, C unit lower triangular; the entries of C are further unknowns, which
do not depend on units. The first cost weight of the inputs is 1, for scale.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import scipy

from impc.arrays import Array, frozen
from impc.checking import Value, checked
from impc.errors import InputError, WeightsError
from impc.model.combinations import linear_combination
from impc.model.plant import Plant
from impc.model.weights import Weights

_WORDS = ("diagonal", "full", "outputs")
# Features count as dependent below this ratio of singular values: their cost weights are ambiguous.
_SAME = 1e-9
# A mode closer than this to the limit of stability does not count as decaying.
_DECAYS = 1e-9


@dataclass(frozen=True, init=False)
class Structure(Value):
    """A cost structure: which features of states and inputs have unknown cost weights.

    Parameters
    ----------
    plant : Plant
        Plant whose states and inputs are meant.
    Q : "diagonal", "full", "outputs", or sequence of str
        A cost weight for each feature; also cost weights of all products of two features; a cost
        weight for each output; or a list of features, such as ``["theta1", "theta2 - theta1"]``,
        each with a cost weight.
    R : "diagonal", "full", or sequence of str
        The same for the inputs. It has no effect with one input.
    over : sequence of str, optional
        Features for ``Q = "diagonal"`` or ``"full"``; by default all states.
    name : str, optional
        Name in tables and sentences.

    Attributes
    ----------
    name : str
        Name in tables and sentences.
    labels : tuple of str
        Features of the states, length k.
    features : ndarray of shape (k, n)
        Their coefficients, one feature per row.
    coupled : bool
        Whether products of features have cost weights too.
    input_labels : tuple of str
        Features of the inputs, length l.
    input_features : ndarray of shape (l, m)
        Their coefficients, one feature per row.
    input_coupled : bool
        Whether products of input features have cost weights too.

    Raises
    ------
    InputError
        If a feature cannot be parsed, or different cost weights give the same weights.
    WeightsError
        If a mode that does not decay by itself, or an input, appears in no feature.

    Examples
    --------
    >>> import control
    >>> import impc
    >>> system = control.ss([[2, -1], [1, 0.2]], [[1], [0]], [[1, 0]], 0, 1, states=["p", "v"])
    >>> shape = impc.Structure(impc.Plant(system), ["p", "v - p"])
    >>> shape.count, shape.unknowns
    (2, ('p', 'v - p'))
    >>> shape.weights([0.0, 0.0]).Q
    array([[ 2., -1.],
           [-1.,  1.]])
    """

    _rules: ClassVar[Mapping[str, Any]] = {"features": "* n", "input_features": "* m"}

    name: str
    labels: tuple[str, ...]
    features: Array
    coupled: bool
    input_labels: tuple[str, ...]
    input_features: Array
    input_coupled: bool

    @checked
    def __init__(
        self,
        plant: Plant,
        Q: str | Sequence[str] = "diagonal",
        R: str | Sequence[str] = "diagonal",
        *,
        over: Sequence[str] | None = None,
        name: str | None = None,
    ) -> None:
        labels, features = _features(plant, "Q", Q, over)
        input_labels, input_features = _inputs(plant, R)
        self._fill(
            name=name or _default_name(Q, over, labels),
            labels=labels,
            features=frozen(features),
            coupled=Q == "full",
            input_labels=input_labels,
            input_features=frozen(input_features),
            input_coupled=R == "full" and plant.m > 1,
        )
        _require_different("Q", labels, features, coupled=self.coupled)
        _require_different("R", input_labels, input_features, coupled=self.input_coupled)
        _require_detectable(plant, features)

    @property
    def count(self) -> int:
        """Number of unknowns."""
        return len(self.unknowns)

    @property
    def unknowns(self) -> tuple[str, ...]:
        """Names of the unknowns (count,): features, then pairs; those of the states first."""
        inputs = _names(self.input_labels, coupled=self.input_coupled)
        return (*_names(self.labels, coupled=self.coupled), *inputs[1:])

    @property
    def is_cost_weight(self) -> np.ndarray[Any, np.dtype[np.bool_]]:
        """Mask (count,) of the unknowns that are logarithms of cost weights, not entries of C."""
        k, rest = len(self.labels), len(self.input_labels) - 1
        each = (k, self._split - k, rest, self.count - self._split - rest)
        return np.repeat([True, False, True, False], each)

    @checked(z="~count")
    def weights(self, z: Array) -> Weights:
        """Return the weights at the unknowns z (count,); -inf is a cost weight of zero.

        Raises
        ------
        WeightsError
            If a cost weight overflows.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            states, inputs = self._factors(z)
            Q, R = states.T @ states, inputs.T @ inputs
        if not (np.all(np.isfinite(Q)) and np.all(np.isfinite(R))):
            raise WeightsError("Q, R", "a cost weight overflows", "start from other unknowns")
        return Weights(Q, R)

    @checked(z="~count")
    def changes(self, z: Array) -> tuple[Array, Array]:
        """Derivatives of Q (count, n, n) and R (count, m, m) with respect to z (count,).

        For a cost weight of zero, with respect to the cost weight itself.
        """
        own, beside = z[: self._split], np.concatenate([[0.0], z[self._split :]])
        dQ = _changes(self.features, own, coupled=self.coupled)
        dR = _changes(self.input_features, beside, coupled=self.input_coupled)[1:]
        n, m = self.features.shape[1], self.input_features.shape[1]
        return (
            np.concatenate([dQ, np.zeros((len(dR), n, n))]),
            np.concatenate([np.zeros((len(dQ), m, m)), dR]),
        )

    @checked(z="~count")
    def reported(self, z: Array) -> tuple[Array, Array]:
        """Unknowns as reported (count,), and their Jacobian (count, count) by `z` (count,).

        These are logarithms of the cost weights W_ii and, if coupled, for each pair the correlation
        W_ij / sqrt(W_ii W_jj), between -1 and 1.
        """
        beside = np.concatenate([[0.0], z[self._split :]])
        first, along = _identified(len(self.labels), z[: self._split], coupled=self.coupled)
        rest, slope = _identified(len(self.input_labels), beside, coupled=self.input_coupled)
        both = scipy.linalg.block_diag(along, slope[1:, 1:])
        return np.concatenate([first, rest[1:]]), np.asarray(both)

    @property
    def _split(self) -> int:
        """Number of unknowns of Q."""
        return len(_names(self.labels, coupled=self.coupled))

    def _factors(self, z: Array) -> tuple[Array, Array]:
        beside = np.concatenate([[0.0], z[self._split :]])
        return (
            _factor(len(self.labels), z[: self._split], coupled=self.coupled).T @ self.features,
            _factor(len(self.input_labels), beside, coupled=self.input_coupled).T
            @ self.input_features,
        )


def _features(
    plant: Plant,
    which: str,
    given: str | Sequence[str],
    over: Sequence[str] | None,
) -> tuple[tuple[str, ...], Array]:
    if isinstance(given, str) and given not in _WORDS:
        words = ", ".join(f'"{word}"' for word in _WORDS)
        raise InputError(which, f"got {given!r}", f"give {words} or a list of features")
    if isinstance(given, str) and given == "outputs":
        if over is not None:
            raise InputError("over", "needs diagonal or full", "leave it out for outputs")
        return tuple(plant.outputs), np.array(plant.C)
    if isinstance(given, str):
        chosen = tuple(plant.states if over is None else over)
    elif over is None:
        chosen = tuple(given)
    else:
        raise InputError("over", "needs diagonal or full", "leave it out with a list of features")
    if not chosen:
        raise InputError(which, "is empty", "name at least one feature")
    return chosen, np.array([linear_combination(text, plant.states) for text in chosen])


def _inputs(plant: Plant, given: str | Sequence[str]) -> tuple[tuple[str, ...], Array]:
    if isinstance(given, str) and given not in _WORDS[:2]:
        raise InputError("R", f"got {given!r}", 'give "diagonal", "full" or a list of features')
    chosen = tuple(plant.controls) if isinstance(given, str) else tuple(given)
    rows = [linear_combination(text, plant.controls) for text in chosen]
    features = np.array(rows).reshape(-1, plant.m)
    if np.linalg.matrix_rank(features) < plant.m:
        raise WeightsError(
            "R", "leaves a combination of the inputs without a cost weight", "add one"
        )
    return chosen, features


def _default_name(
    Q: str | Sequence[str], over: Sequence[str] | None, labels: tuple[str, ...]
) -> str:
    if not isinstance(Q, str):
        return ", ".join(labels)
    return Q if over is None else f"{Q} over {', '.join(labels)}"


def _require_different(
    which: str, labels: tuple[str, ...], features: Array, *, coupled: bool
) -> None:
    """Require linearly independent features (if not coupled, outer products of features)."""
    unit = features / np.linalg.norm(features, axis=1)[:, None]
    products = np.array([np.outer(row, row).ravel() for row in unit])
    values = np.linalg.svd(unit if coupled else products, compute_uv=False)
    if len(values) < len(labels) or values[-1] < _SAME * values[0]:
        raise InputError(
            which,
            f"different cost weights of {', '.join(labels)} give the same weights",
            "remove one",
        )


def _require_detectable(plant: Plant, features: Array) -> None:
    """Require that every mode that does not decay by itself appears in a feature."""
    limit = 1 - _DECAYS if plant.discrete else -_DECAYS
    unit = features / np.linalg.norm(features, axis=1)[:, None]
    for mode in np.linalg.eigvals(plant.A):
        if (abs(mode) if plant.discrete else mode.real) < limit:
            continue
        pencil = np.vstack([plant.A - mode * np.eye(plant.n), unit])
        _, values, rows = scipy.linalg.svd(pencil)
        if values[-1] < _SAME * values[0]:
            part = np.abs(rows[-1])
            names = [plant.states[index] for index in np.argsort(-part) if part[index] > 0.1]
            raise WeightsError(
                "Q",
                f"leaves the mode {_number(mode)}, which does not decay by itself, without a cost "
                "weight",
                f"penalise one of {', '.join(names)}",
            )


def _number(mode: complex) -> str:
    return f"{mode.real:.4g}" if mode.imag == 0 else f"{mode:.4g}"


def _names(labels: tuple[str, ...], *, coupled: bool) -> tuple[str, ...]:
    pairs = zip(*np.tril_indices(len(labels), -1), strict=True) if coupled else ()
    return (*labels, *(f"{labels[j]} with {labels[i]}" for i, j in pairs))


def _factor(size: int, z: Array, *, coupled: bool) -> Array:
    """Factor L of W = L L'."""
    scale = np.diag(np.exp(z[:size] / (1 if coupled else 2)))
    if not coupled:
        return np.asarray(scale)
    C = np.eye(size)
    C[np.tril_indices(size, -1)] = z[size:]
    return np.asarray(scale @ C)


def _identified(size: int, z: Array, *, coupled: bool) -> tuple[Array, Array]:
    """Logarithms of W_ii and correlations, and their Jacobian with respect to z."""
    if not coupled:
        return z, np.eye(size)
    L, steps = _factor(size, z, coupled=True), _steps(size, z)
    W, dW = L @ L.T, steps @ L.T + L @ steps.transpose(0, 2, 1)
    cost_weight, root = np.diag(W), np.sqrt(np.diag(W))
    d_weight = np.einsum("kii->ik", dW) / cost_weight[:, None]
    rows, columns = np.tril_indices(size, -1)
    size_of = root[rows] * root[columns]
    pair = W[rows, columns] / size_of
    d_pair = dW[:, rows, columns].T / size_of[:, None]
    d_pair -= pair[:, None] * (d_weight[rows] + d_weight[columns]) / 2
    return np.concatenate([np.log(cost_weight), pair]), np.vstack([d_weight, d_pair])


def _changes(features: Array, z: Array, *, coupled: bool) -> Array:
    size = len(features)
    if not coupled:
        cost_weight = np.where(np.isneginf(z), 1.0, np.exp(z))
        return np.asarray(np.einsum("k,ki,kj->kij", cost_weight, features, features))
    half = _steps(size, z) @ _factor(size, z, coupled=True).T
    return np.asarray(features.T @ (half + half.transpose(0, 2, 1)) @ features)


def _steps(size: int, z: Array) -> Array:
    """Derivatives of L with respect to z."""
    L = _factor(size, z, coupled=True)
    steps = []
    for index in range(size):
        steps.append(np.zeros((size, size)))
        steps[-1][index] = L[index]
    for row, column in zip(*np.tril_indices(size, -1), strict=True):
        steps.append(np.zeros((size, size)))
        steps[-1][row, column] = np.exp(z[row])
    return np.array(steps)
