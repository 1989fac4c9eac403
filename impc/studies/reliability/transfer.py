"""Empirical transfer function estimates from the input to each output, with coherence.

    G(f_k) = Y(f_k) / U(f_k)                                  one trial (ETFE, Ljung 1999)
    G(f_k) = sum_j Y_j conj(U_j) / sum_j |U_j|^2              several trials, H1
    C(f_k) = |sum_j Y_j conj(U_j)|^2 / (sum_j |U_j|^2 sum_j |Y_j|^2)

at the excited frequencies of the passband. The loop is closed, and no obstacle: the torque on the
seat comes from outside. With trials of one and the same input H1 is the mean of the trials' ETFE.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array
from impc.errors import DataError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.studies.reliability.measures import Passband

#: An array of complex numbers.
ComplexArray = np.ndarray[tuple[int, ...], np.dtype[np.complex128]]


@dataclass(frozen=True)
class TransferFunction:
    """Estimate at a few frequencies."""

    frequency: Array  # Hz (f,)
    response: ComplexArray  # Output over input (f, p)
    coherence: Array  # (f, p); 1 for a single trial, which cannot tell


def transfer_function(
    inputs: Sequence[Array], outputs: Sequence[Array], rate: float, band: Passband
) -> TransferFunction:
    """Estimate from one or several trials of the same length.

    `inputs` (samples,); `outputs` (samples, p); `rate` in second.
    """
    if not inputs:
        raise DataError("transfer function", "has no trial", "give one or more")
    lengths = {len(item) for item in (*inputs, *outputs)}
    if len(lengths) > 1:
        raise DataError(
            "trials", f"have {', '.join(map(str, sorted(lengths)))} samples", "cut them alike"
        )
    (samples,) = lengths
    chosen = band.excited
    if chosen[-1] > samples // 2:
        raise DataError("trials", "are shorter than the input of the passband", "cut them alike")
    U = np.array([np.fft.rfft(item)[chosen] for item in inputs])
    Y = np.array([np.fft.rfft(item, axis=0)[chosen] for item in outputs])
    power = np.sum(np.abs(U) ** 2, axis=0)[:, None]
    cross = np.sum(Y * np.conj(U)[..., None], axis=0)
    total = power * np.sum(np.abs(Y) ** 2, axis=0)
    coherence = np.divide(np.abs(cross) ** 2, total, out=np.zeros(total.shape), where=total > 0)
    return TransferFunction(np.asarray(chosen * (rate / samples)), cross / power, coherence)
