"""Commands of the `impc` program: arguments and help; what they do is imported when one runs."""

from __future__ import annotations

from pathlib import Path

import click

from impc.cli import options
from impc.cli.plant import KNOWN

_PATH = click.Path(path_type=Path)
#: Usual number of seeds of `impc example --sweep`.
SEEDS = 7


@click.command("fit")
@options.subject_arguments(
    "Meaning of the columns, and settings; `impc inspect FILE` drafts this file."
)
@options.out_option("fit", "report.html, result.json, tables and the figures")
@options.page_options
@options.runs("fit:run_fit")
def fit() -> None:
    """Fit the controller behind the trials of one subject, one file a trial.

    If you interrupt it, the same command continues from the last finished step. If the plant is an
    impc.OptimalControlProblem, its parameters are fitted (docs/howto/nonlinear.md).
    """


@click.command("compare")
@options.subject_arguments("Meaning of the columns, and settings, as for `impc fit`.")
@options.out_option("compare", "report.html, result.json, tables and the figure")
@options.page_options
@options.runs("fit:run_compare")
def compare() -> None:
    """Compare feedback gain, inverse LQR and inverse MPC, one file a trial.

    Each method is fitted to all trials, and once without each trial. If you interrupt it, the same
    command continues from the last finished fit.
    """


@click.command("inspect")
@click.argument("file", type=_PATH)
@click.option(
    "--plant",
    "plant_name",
    help=f"Plant whose signals are looked for: {', '.join(KNOWN)}, module:function, or a file.",
)
@click.option(
    "--out",
    type=_PATH,
    help="Write the configuration to this file instead of the screen; never overwrites a file.",
)
@click.option(
    "--config", type=_PATH, help="Check the file against this configuration; needs --plant."
)
@click.option("--open", "open_page", is_flag=True, help="Draw every signal on a page, and open it.")
@options.runs("inspect:run_inspect")
def inspect() -> None:
    """Show what a recording holds and write a commented configuration for it."""


@click.command("cohort")
@options.study_options(
    "plant", "cohort", "results, tables and report; give the same folder again to continue"
)
@options.page_options
@options.scheduler_options
@options.yes_option
@options.runs("cohort:run_cohort")
def cohort() -> None:
    """Fit every subject, visit and condition of a study, with bootstrap replicates.

    Ends with status 1 if a subject could not be fitted, and names the reason. If you interrupt it,
    the same command continues from the last finished task.
    """


@click.command("results")
@click.argument("folder", type=_PATH)
@click.option(
    "--out",
    type=_PATH,
    help="Write all columns to this .xlsx file, with command, versions and SHA-256 of the inputs "
    "in a second sheet, or to this .csv file; never overwrites a file.",
)
@options.runs("results:run_results")
def results() -> None:
    """Show the fits in a folder and below, one row each, newest first.

    Gains that the page of a fit forbids to report are empty; the column reason says why.
    """


@click.command("reliability")
@options.study_options("plant", "reliability", "report.html, result.json, tables and figures")
@options.page_options
@click.option(
    "--last", type=click.IntRange(min=1), default=3, help="Use the last N trials of each visit."
)
@options.runs("cohort:run_reliability")
def reliability() -> None:
    """Analyse test-retest reliability over subjects, visits, conditions and trials.

    The study file is that of `impc cohort`.
    """


@click.command("plan")
@click.argument("config", metavar="CONFIG", type=_PATH)
@click.option("--plant", "plant_name", help=f"{', '.join(KNOWN)}; or as for `impc fit`.")
@click.option(
    "--like",
    type=_PATH,
    help="Folder of `impc fit`: plant, settings, gain and noise of the assumed subject; or of "
    "`impc simulate seated-balance`: its gain. Keys in CONFIG take precedence.",
)
@options.out_option("plan", "report.html, result.json, tables and the figures")
@options.page_options
@options.yes_option
@options.runs("plan:run_plan")
def plan() -> None:
    """Plan an experiment for an assumed subject, from the [plan] table of CONFIG.

    CONFIG may be the file that `impc fit` reads later: [plant] and [fit] mean the same. If you
    interrupt the command, the same command continues from the last finished step.
    """


@click.command("select")
@options.study_options("model", "select", "report.html, result.json, tables and figure")
@options.page_options
@options.scheduler_options
@options.yes_option
@options.runs("select:run_select")
def select() -> None:
    """Select sensitive parameters of a simulation model (chapter 4), per subject and pooled.

    [study] model is the import path of the model, [model] has its arguments, [select] the settings.
    If you interrupt the command, the same command continues from the last finished task.
    """


@click.command("key-parameters")
@options.study_options("model", "key-parameters", "report.html, result.json, table and figure")
@click.option(
    "--bound",
    type=options.Number(min=0, max=1e6, min_open=True),
    default=0.35,
    help="Largest allowed variance of a parameter, in squared halves of its range.",
)
@click.option("--vaf", type=options.Number(), default=69.0, help="Smallest allowed mean VAF, %.")
@click.option(
    "--icc",
    type=options.Number(),
    help="Smallest allowed lower end of the 95 % interval of ICC(A,k). Default: 0.6, good.",
)
@options.page_options
@options.scheduler_options
@options.yes_option
@options.runs("select:run_key_parameters")
def key_parameters() -> None:
    """Find key parameters (chapter 5) in a study of several subjects and visits.

    The study file is that of `impc select`. If you interrupt the command, the same command
    continues from the last finished task.
    """


@click.command("example")
@click.option(
    "--case",
    type=click.Choice(["A", "B", "C", "all"]),
    default="all",
    help="Initial state: A (1, 3), B (2, 3), C (2, 1).",
)
@click.option(
    "--sweep",
    type=click.Choice(["example", "seat"]),
    help="Instead of the cases: inverse MPC against inverse LQR over 0 to 60 % of samples at the "
    "limit, exact, with noise, a wrong limit and a wrong plant, on the example's plant "
    "(minutes) or the seat (longer).",
)
@click.option("--seeds", type=click.IntRange(1, 1000), default=SEEDS, help="Seeds of --sweep.")
@options.out_option("example", "report.html, result.json, tables and the figures")
@options.page_options
@options.solver_option
@options.runs("example:run_example")
def example() -> None:
    """Run the simulation example of the dissertation with all methods.

    The dissertation does not give matrices, initial state and bound; a plant with the properties
    that its text describes replaces them. If you interrupt a sweep, the same command continues it.
    """


@click.command("warm")
@click.option("--sensory-noise", is_flag=True, help="Also compile the filter of sensory noise.")
@options.runs("warm:run_warm")
def warm() -> None:
    """Compile the inner loops of all commands once; takes about half a minute.

    `make demo` calls it; after an installation by pip, call it yourself. Without it, the first
    command that needs compiled code compiles it and says so. So does the first fit with sensory
    noise: its filter is compiled here only with --sensory-noise.
    """
