"""Sound files whose clock, signals or configuration cannot be right."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from impc.arrays import Array
from tests.files.damage import OWN_RATE, Damage, Made, register, written
from tests.files.samples import csv_text, pushed_seat, settings

__all__ = ["DAMAGED_SIGNALS"]

DAMAGED_SIGNALS: dict[str, Damage] = {}


def _damage(phrase: str, in_file: bool = False) -> Callable[[Callable[[Path], Made]], None]:
    return register(DAMAGED_SIGNALS, phrase, in_file)


def _csv(folder: Path, **changed: Array) -> Path:
    return written(folder, csv_text({**pushed_seat(), **changed}))


# The clock ------------------------------------------------------------------------------------


def _time(change: Callable[[Array], object]) -> Array:
    time = pushed_seat()["time"].copy()
    change(time)
    return time


@_damage("is repeated 3 times, the first from sample 101 to 102")
def _duplicated_time_stamps(folder: Path) -> Made:
    time = _time(lambda time: time.__setitem__(slice(101, 104), time[100]))
    return _csv(folder, time=time), settings()


@_damage("runs backward 1 times, the first from sample 300 to 301")
def _clock_that_runs_backward(folder: Path) -> Made:
    time = _time(lambda time: time.__setitem__(slice(300, 600), time[:300]))
    return _csv(folder, time=time), settings()


@_damage("has 1 missing times, the first in sample 8")
def _missing_time(folder: Path) -> Made:
    return _csv(folder, time=_time(lambda time: time.__setitem__(7, np.nan))), settings()


@_damage("has 1 gaps, the first at 2 s, the longest of 0.51 s")
def _gap_in_the_clock(folder: Path) -> Made:
    time = _time(lambda time: time.__setitem__(slice(201, 600), time[201:] + 0.5))
    return _csv(folder, time=time), settings()


@_damage("is uneven")
def _uneven_clock(folder: Path) -> Made:
    time = np.cumsum(np.where(np.arange(600) % 2, 0.0196, 0.0004))
    return _csv(folder, time=time), settings()


@_damage("column 'clock': is not in the file")
def _absent_clock(folder: Path) -> Made:
    return _csv(folder), settings(('"time"', '"clock"'))


@_damage("tells no clock and no rate")
def _unknown_rate(folder: Path) -> Made:
    return _csv(folder), settings(OWN_RATE)


@_damage("is no time")
def _clock_in_degrees(folder: Path) -> Made:
    return _csv(folder), settings(('time = "time"', 'time = "time"\ntime_unit = "deg"'))


@_damage("does not reach recording.stop = 60 s")
def _cut_behind_the_end(folder: Path) -> Made:
    return _csv(folder), settings(('time = "time"', 'time = "time"\nstop = 60.0'))


# Channels -------------------------------------------------------------------------------------


def _seat(change: Callable[[Array], object]) -> Array:
    seat = pushed_seat()["seat"].copy()
    change(seat)
    return seat


@_damage("column 'seat angle': is not in the file")
def _absent_column(folder: Path) -> Made:
    return _csv(folder), settings(('"seat"', '"seat angle"'))


@_damage("is in 'rad' by the configuration and in 'deg' by the file")
def _units_swapped_against_the_file(folder: Path) -> Made:
    text = csv_text(pushed_seat()).replace("seat", "seat (deg)", 1)
    return written(folder, text), settings(
        ('column = "seat"\nunit = "deg"\nlimit = 12.0', 'column = "seat"\nunit = "rad"')
    )


@_damage("degrees taken for radians")
def _degrees_called_radians(folder: Path) -> Made:
    return _csv(folder), settings(('unit = "deg"\nlimit = 12.0', 'unit = "rad"'))


@_damage("radians taken for degrees")
def _radians_called_degrees(folder: Path) -> Made:
    return _csv(folder, seat=_seat(lambda seat: np.deg2rad(seat, out=seat))), settings()


@_damage("10 of 600 samples are missing or not finite, the first sample 51")
def _missing_samples(folder: Path) -> Made:
    seat = _seat(lambda seat: seat.__setitem__(slice(50, 60), np.nan))
    return _csv(folder, seat=seat), settings()


@_damage("1 of 600 samples are missing or not finite, the first sample 100")
def _infinite_sample(folder: Path) -> Made:
    return _csv(folder, seat=_seat(lambda seat: seat.__setitem__(99, np.inf))), settings()


@_damage("at an end of the recording")
def _missing_end(folder: Path) -> Made:
    seat = _seat(lambda seat: seat.__setitem__(slice(590, 600), np.nan))
    return _csv(folder, seat=seat), settings(('time = "time"', 'time = "time"\nfill_gaps = 1.0'))


@_damage("is constant at 0 deg in all 600 samples")
def _constant_channel(folder: Path) -> Made:
    return _csv(folder, seat=np.zeros(600)), settings()


@_damage("is constant at 0 Nm")
def _perturbation_that_never_acts(folder: Path) -> Made:
    return _csv(folder, push=np.zeros(600)), settings()


@_damage("is beyond its stop of 12 deg")
def _angle_beyond_the_stop(folder: Path) -> Made:
    return _csv(folder, seat=_seat(lambda seat: seat.__setitem__(70, 13.0))), settings()


@_damage("is clipped at 2 deg")
def _clipped_channel(folder: Path) -> Made:
    return _csv(folder, seat=np.clip(pushed_seat()["seat"], -2.0, 2.0)), settings()


@_damage("has 40 samples at the plant's rate, 50 are needed")
def _too_few_samples(folder: Path) -> Made:
    short = {name: values[:40] for name, values in pushed_seat().items()}
    return written(folder, csv_text(short)), settings()


# The configuration ----------------------------------------------------------------------------


@_damage("signals.theta2: is missing")
def _output_without_a_column(folder: Path) -> Made:
    return _csv(folder), settings(('[signals.theta2]\ncolumn = "trunk"\nunit = "deg"\n', ""))


@_damage("signals.theta3: is no output")
def _signal_that_the_plant_lacks(folder: Path) -> Made:
    return _csv(folder), settings(("signals.theta2", "signals.theta3"))


@_damage("signals.theta1.limt: is not known; did you mean limit?")
def _misspelled_key(folder: Path) -> Made:
    return _csv(folder), settings(("limit", "limt"))


@_damage("signals.theta1.limit: Expected 'float | null', got 'str'")
def _limit_in_words(folder: Path) -> Made:
    return _csv(folder), settings(("limit = 12.0", 'limit = "12"'))


@_damage("unit 'wibble' is not known")
def _unknown_unit(folder: Path) -> Made:
    return _csv(folder), settings(('unit = "Nm"', 'unit = "wibble"'))


@_damage("signals.perturbation.unit: is still '?'")
def _unit_not_filled_in(folder: Path) -> Made:
    return _csv(folder), settings(('unit = "Nm"', 'unit = "?"'))


@_damage("is not TOML")
def _configuration_that_is_no_toml(folder: Path) -> Made:
    return _csv(folder), settings(("[signals.theta1]", "[signals.theta1"))


@_damage("does not match recording.pattern")
def _name_that_does_not_match(folder: Path) -> Made:
    pattern = "pattern = '(?P<subject>[^_]+)_(?P<trial>[0-9]+)'"
    return _csv(folder), settings(('subject = "S01"', pattern))


@_damage("is no regular expression")
def _pattern_that_is_none(folder: Path) -> Made:
    return _csv(folder), settings(('subject = "S01"', "pattern = '(?P<subject>'"))
