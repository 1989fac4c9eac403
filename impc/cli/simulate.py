"""`impc simulate`: arguments and help of the commands that simulate recordings."""

from __future__ import annotations

import click

from impc.cli.options import Number, out_option, runs, seed_option

_POSITIVE, _SIZE = Number(min=0, max=1e6, min_open=True), Number(min=0, max=1e6)


@click.group("simulate")
def command() -> None:
    """Write recordings of a simulated subject, with the true values in truth.json."""


@command.command("seated-balance")
@out_option("subject", "the recordings, subject.toml and truth.json")
@click.option(
    "--torque-limit", type=_POSITIVE, default=6.0, help="Largest torque of the subject, N m."
)
@click.option("--trials", type=click.IntRange(1, 99), default=3, help="Number of trials.")
@click.option("--duration", type=Number(min=2, max=600), default=30.0, help="Of each trial, s.")
@click.option(
    "--amplitude", type=_POSITIVE, default=5.0, help="Of the ternary torque on the seat, N m."
)
@click.option(
    "--motor-noise",
    type=_SIZE,
    show_default="0, with --observer 0.3",
    help="Standard deviation of the noise on the torque, N m; a fit without [fit.observer] treats "
    "it as recording noise.",
)
@click.option(
    "--sensor-noise",
    type=_SIZE,
    default=0.1,
    help="Standard deviation of the recording noise on the angles, degrees.",
)
@click.option(
    "--observer",
    is_flag=True,
    help="The subject senses angles and rates with noise, and acts on estimates of the states.",
)
@click.option(
    "--sensory-noise",
    type=_POSITIVE,
    default=0.1,
    help="With --observer: standard deviation of one sensed sample (0.01 s) of an angle, degrees; "
    "of a rate, ten times that per second.",
)
@click.option(
    "--unknown-perturbation",
    is_flag=True,
    help="With --observer: the subject does not know the torque on the seat, and estimates it.",
)
@click.option("--mass", type=Number(), default=79.7, help="Body mass, kg.")
@click.option("--height", type=Number(), default=1.66, help="Body height, m.")
@click.option("--sex", type=click.Choice(["male", "female"]), default="male")
@seed_option
@click.option(
    "--formats",
    show_default="all that are installed",
    help="Comma-separated list of csv, tsv, xlsx, mat, tdms and c3d.",
)
@runs("simulate_subject:run_seated_balance")
def seated_balance() -> None:
    """Simulate a subject who balances on a tilting seat with a bounded controller.

    1000 samples a second; the nonlinear plant of the dissertation with parameters from body mass
    and height. truth.json holds the true gain and weights.
    """


@command.command("cohort")
@out_option("cohort-data", "the recordings, study.toml, participants.tsv and truth.json")
@click.option(
    "--subjects", type=click.IntRange(2, 9999), default=30, help="Number in both groups together."
)
@click.option("--visits", type=click.IntRange(1, 9), default=1, help="Per subject.")
@click.option("--trials", type=click.IntRange(1, 9), default=3, help="Per visit.")
@click.option("--duration", type=Number(5, 600), default=30.0, help="Of each trial, s.")
@click.option(
    "--difference",
    type=Number(min=0.05, max=20),
    default=0.4,
    help="Ratio of the cost weights of angles and rates, second group to first; 1: no difference.",
)
@click.option(
    "--torque-limit",
    type=Number(min=1, max=1e6),
    default=6.0,
    help="Largest lumbar torque of a subject, N m.",
)
@click.option(
    "--motor-noise",
    type=_SIZE,
    default=0.0,
    help="Standard deviation of the noise on the torque, N m; a fit treats it as recording noise.",
)
@click.option(
    "--replicates",
    type=click.IntRange(0, 1_000_000),
    default=20,
    help="Bootstrap replicates, written to study.toml.",
)
@seed_option
@runs("simulate_cohort:run_cohort")
def cohort() -> None:
    """Simulate two groups of seated subjects, in folders with BIDS names.

    The groups differ only in the cost weights of angles and rates relative to torque. Body mass and
    height differ between subjects, cost weights between subjects and visits. 100 samples a second.
    """


@command.command("reliability-study")
@out_option("reliability-data", "the recordings, study.toml and truth.json")
@click.option("--subjects", type=click.IntRange(2, 999), default=30, help="Number of subjects.")
@click.option("--visits", type=click.IntRange(2, 9), default=3, help="Per subject.")
@click.option("--trials", type=click.IntRange(2, 9), default=3, help="Per visit and condition.")
@seed_option
@runs("simulate_studies:run_reliability_study")
def reliability_study() -> None:
    """Simulate a reliability study of seated subjects under three conditions.

    Bodies differ between subjects; cost weights of angles and rates between subjects and visits;
    sway between subjects, visits and trials; mean lean between visits. Closed eyes and vibration
    change cost weights, sway and noise. A trial lasts 29.04 s, one period of the ternary torque, at
    100 samples a second.
    """


@command.command("head-tracking")
@out_option("head-data", "the recordings, study.toml and truth.json")
@click.option(
    "--axis", type=click.Choice(["yaw", "pitch"]), default="yaw", help="Of the head's rotation."
)
@click.option("--subjects", type=click.IntRange(1, 999), default=10, help="Number of subjects.")
@click.option("--visits", type=click.IntRange(1, 9), default=1, help="Per subject.")
@click.option("--trials", type=click.IntRange(1, 9), default=3, help="Per visit.")
@click.option("--duration", type=Number(5, 300), default=30.0, help="Of each trial, s.")
@seed_option
@runs("simulate_studies:run_head_tracking")
def head_tracking() -> None:
    """Simulate head tracking as in chapter 4; --subjects 40 --visits 2 for chapter 5.

    Subjects differ in all twelve parameters, drawn around the nominal values of table 4.3 such that
    the loop is stable, and in the noise.
    """
