"""What no measurement is: numbers and clocks beyond anything recorded, before they are used.

Whatever passes here can be squared, summed and resampled within the memory that the file itself
took, a few times over.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impc.errors import DataError

if TYPE_CHECKING:
    from impc.arrays import Array
    from impc.files.checks import Channel

# In SI units. Fourth powers of both are still numbers, and nothing measured comes near.
_LARGEST, _SMALLEST = 1e50, 1e-50
_LONGEST = 1e12  # s on a clock: 30 000 years; 1.7e9 is a count from 1970
_PERIODS = (1e-9, 1e6)  # s
# The plant's samples for one of the recording: milliseconds taken for seconds are 1000.
_SLOWER = 50
_GAPS = 10  # even instants for each sample, where gaps may be filled


def size(channel: Channel) -> str:
    """A channel whose values are too large, or all but nothing."""
    finite = np.abs(channel.values[np.isfinite(channel.values)])
    largest = float(finite.max(initial=0.0))
    if largest > _LARGEST / channel.unit.factor:
        first = int(np.argmax(np.abs(channel.values) > _LARGEST / channel.unit.factor))
        raise DataError(
            channel.name,
            f"is {channel.values[first]:.3g} {channel.unit.written} in {channel.at(first)}, which "
            "is no measurement",
            f"correct the column, or offset and unit in signals.{channel.signal}",
        )
    if 0 < largest < _SMALLEST / channel.unit.factor:
        raise DataError(
            channel.name,
            f"is at most {largest:.3g} {channel.unit.written}, which is no measurement",
            f"correct the column, or the unit in signals.{channel.signal}",
        )
    return ""


def times_of_a_recording(subject: str, time: Array) -> None:
    """Require that the `time` of a clock (samples,), in s, is near enough to zero.

    `subject` names file and clock in the message.
    """
    furthest = float(max(abs(time[0]), abs(time[-1])))
    if furthest > _LONGEST:
        raise DataError(
            subject, f"reaches {furthest:.3g} s", "correct the clock, or recording.time_unit"
        )


def period_of_a_recording(subject: str, period: float) -> None:
    """Require that a recorder has the `period`, in s; `subject` names file and clock."""
    if not _PERIODS[0] <= period <= _PERIODS[1]:
        raise DataError(
            subject,
            f"has a sample every {period:.3g} s",
            f"correct the rate or the clock's unit: {_PERIODS[0]:g} to {_PERIODS[1]:g} s can be",
        )


def comparable_rates(subject: str, period: float, dt: float) -> None:
    """Require that a recording is not much slower than the plant: its `period`, and `dt`, in s.

    `subject` names the file in the message.
    """
    if period > _SLOWER * dt:
        raise DataError(
            subject,
            f"has a sample every {period:.4g} s, and the plant one every {dt:.4g} s",
            "correct recording.time_unit or rate, or give the plant a longer dt",
        )


def few_gaps(subject: str, time: Array, period: float) -> None:
    """Require that the `time` of a clock (samples,) has few gaps; its usual `period`, both in s.

    `subject` names file and clock in the message.
    """
    instants = (time[-1] - time[0]) / period
    if instants > _GAPS * len(time):
        raise DataError(
            subject,
            f"has {len(time)} samples on {instants:.3g} even instants: the rest are gaps",
            "cut with recording.start and stop",
        )
