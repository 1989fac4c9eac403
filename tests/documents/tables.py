"""What is run in another way than the pages say, and why. Nothing else is."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["NOT_RUN", "PREPARED", "SMALLER", "Smaller"]


@dataclass(frozen=True)
class Smaller:
    """What is run instead of a line of a page."""

    lines: tuple[str, ...]
    reason: str


_ENVIRONMENT = "makes an environment; the tests run inside one"
_WHOLE = "runs what these tests are a part of"
_SITE = "builds the site: four minutes"
_PUBLISH = "publishes, or needs a network"
_CERTIFICATES = "needs openssl; tests/studies/test_scheduler.py runs these lines where it is there"
_CLUSTER = "needs machines of a cluster; tests/cohort starts a scheduler and workers of its own"

#: (page, line) -> why it is not run.
NOT_RUN = {
    ("README.md", "make demo"): _ENVIRONMENT,
    ("README.md", "make test"): _ENVIRONMENT,
    ("README.md", ". .venv/bin/activate"): _ENVIRONMENT,
    ("docs/start.md", "make demo"): _ENVIRONMENT,
    ("docs/start.md", ". .venv/bin/activate"): _ENVIRONMENT,
    **{
        ("docs/contributing.md", f"make {target}"): _WHOLE
        for target in ("check", "test", "full", "slow", "fuzz", "search", "look", "numerics")
    },
    ("docs/contributing.md", "python -m pytest tests/documents -k start"): _WHOLE,
    ("docs/contributing.md", "python -m pytest tests/model/test_riccati.py"): _WHOLE,
    ("docs/contributing.md", "make docs"): _SITE,
    (
        "docs/contributing.md",
        "python -m sphinx -W -D sphinx_gallery_conf.filename_pattern=nothing docs docs/_build/html",
    ): _SITE,
    (
        "docs/cohorts.md",
        "openssl req -x509 -newkey rsa:2048 -nodes -days 365 -subj /CN=impc-ca"
        " -keyout ca-key.pem -out ca.pem",
    ): _CERTIFICATES,
    (
        "docs/cohorts.md",
        "openssl req -newkey rsa:2048 -nodes -subj /CN=impc -keyout key.pem -out request.pem",
    ): _CERTIFICATES,
    (
        "docs/cohorts.md",
        "openssl x509 -req -in request.pem -CA ca.pem -CAkey ca-key.pem -CAcreateserial"
        " -days 365 -out cert.pem",
    ): _CERTIFICATES,
    ("docs/cohorts.md", "chmod 600 key.pem ca-key.pem"): _CERTIFICATES,
    **{
        (
            "docs/cohorts.md",
            f"{line} --tls-ca{kind} ca.pem --tls-cert cert.pem --tls-key key.pem",
        ): (_CLUSTER)
        for kind, line in (
            ("-file", "dask scheduler --protocol tls --port 8786"),
            ("-file", "dask worker tls://HOST:8786 --nthreads 1 --nworkers 32"),
            ("", "impc cohort study.toml --out results --scheduler tls://HOST:8786"),
        )
    },
    (
        "docs/cursor-tracking.md",
        "python -m experiments.cursor_tracking --out results/cursor-tracking",
    ): "needs recordings that are no part of the project; test_cursor_tracking.py has them",
    (
        "docs/cursor-tracking.md",
        "python -m experiments.cursor_structures --out results/cursor-structures",
    ): "needs the same recordings; test_cursor_structures.py has one blur",
    ("docs/release.md", "make wheel"): "builds in the checkout, and needs a network",
    (
        "docs/release.md",
        "python -m zipfile --list dist/impc-0.1.0-py3-none-any.whl",
    ): "needs the wheel",
    ("docs/release.md", 'git tag -a v0.1.0 -m "impc 0.1.0"'): _PUBLISH,
    ("docs/release.md", "git push origin v0.1.0"): _PUBLISH,
}

# A trial of 4 s instead of 30 s; a fit with six states instead of ten, over 4 samples instead of
# 20, and not once more for every trial: a tenth of the time.
_SUBJECT = "impc simulate seated-balance --out {0} --duration 4 --formats csv,xlsx"
_EASIER = (
    "edit {0}/subject.toml [plant] '[plant]\ndelay_order = 1'",
    "edit {0}/subject.toml 'horizon = 20' 'held_out = false\nintent_draws = false\nhorizon = 4'",
)
_SEAT = tuple(line.format("results/subject") for line in (_SUBJECT, *_EASIER))
_HERE = tuple(line.format(".") for line in (_SUBJECT, *_EASIER))
_SHORT = "shorter trials, and a smaller fit of them"

#: (page, line) -> what is run instead.
SMALLER = {
    ("README.md", "impc simulate seated-balance --out results/subject"): Smaller(_SEAT, _SHORT),
    (
        "README.md",
        "impc fit results/subject/trial_1.xlsx results/subject/trial_2.xlsx"
        " results/subject/trial_3.xlsx --plant seated-balance --config excel.toml"
        " --out results/excel",
    ): Smaller(
        (
            "edit excel.toml [plant] '[plant]\ndelay_order = 1'",
            "edit excel.toml 'horizon = 20' 'held_out = false\nintent_draws = false\nhorizon = 4'",
            "edit excel.toml 'u_max = \"?\"' 'u_max = 6.0'",
            "edit excel.toml 'mass = \"?\"' 'mass = 79.7'",
            "edit excel.toml 'height = \"?\"' 'height = 1.66'",
            "impc fit results/subject/trial_1.xlsx results/subject/trial_2.xlsx"
            " --plant seated-balance --config excel.toml --out results/excel",
        ),
        _SHORT,
    ),
    (
        "README.md",
        "impc fit lab_1.csv --plant seated-balance --config lab.toml --out results/lab",
    ): Smaller(
        (
            "edit lab.toml [plant] '[plant]\ndelay_order = 1'",
            "edit lab.toml 'horizon = 20' 'intent_draws = false\nhorizon = 4'",
            "impc fit lab_1.csv --plant seated-balance --config lab.toml --out results/lab",
        ),
        _SHORT,
    ),
    ("docs/start.md", "impc simulate seated-balance --out results/subject"): Smaller(_SEAT, _SHORT),
    (
        "docs/recordings.md",
        "impc inspect trial_1.csv --plant seated-balance --config subject.toml",
    ): Smaller(
        (
            "edit subject.toml 'mass = \"?\"' 'mass = 79.7'",
            "edit subject.toml 'height = \"?\"' 'height = 1.66'",
            "impc inspect trial_1.csv --plant seated-balance --config subject.toml",
        ),
        "an editor fills in what is asked for",
    ),
    (
        "docs/recordings.md",
        "impc fit trial_*.csv --plant seated-balance --config subject.toml",
    ): Smaller(
        (
            "edit subject.toml [plant] '[plant]\ndelay_order = 1'",
            "edit subject.toml 'horizon = 20' 'held_out = false\nhorizon = 4'",
            "edit subject.toml [fit] '[fit]\nintent_draws = false'",
            "edit subject.toml 'u_max = \"?\"' 'u_max = 6.0'",
            "impc fit trial_*.csv --plant seated-balance --config subject.toml",
        ),
        _SHORT,
    ),
    (
        "docs/noisy-people.md",
        "impc simulate seated-balance --observer --sensory-noise 0.2 --unknown-perturbation"
        " --out subject",
    ): Smaller(
        (
            "impc simulate seated-balance --observer --sensory-noise 0.2 --unknown-perturbation"
            " --out subject --duration 4 --formats csv",
        ),
        "shorter trials in one format",
    ),
    ("docs/planning.md", "impc plan plan.toml --plant seated-balance --out results/plan"): Smaller(
        (
            "edit plan.toml [plant] '[plant]\ndelay_order = 1'",
            "edit plan.toml 'horizon = 20' 'horizon = 4'",
            "impc plan plan.toml --plant seated-balance --out results/plan",
        ),
        "six states for ten, and a shorter horizon",
    ),
    ("docs/cohorts.md", "impc simulate cohort --out results/cohort-data"): Smaller(
        (
            "impc simulate cohort --out results/cohort-data"
            " --subjects 2 --trials 1 --duration 5 --replicates 0",
        ),
        "two short subjects without a bootstrap, for thirty with 20 replicates",
    ),
    ("docs/cohorts.md", "impc cohort results/cohort-data/study.toml --out results/cohort"): Smaller(
        ("impc cohort results/cohort-data/study.toml --out results/cohort --workers 1",),
        "one worker to start, whatever the cores",
    ),
    (
        "docs/reliability.md",
        "impc simulate reliability-study --out results/reliability-data",
    ): Smaller(
        ("impc simulate reliability-study --out results/reliability-data --subjects 2",),
        "two subjects for thirty",
    ),
    ("docs/selection.md", "impc simulate head-tracking --out results/head-data"): Smaller(
        (
            "impc simulate head-tracking --out results/head-data"
            " --subjects 1 --trials 1 --duration 6",
            "edit results/head-data/study.toml 'replicates = 200' 'replicates = 20\nstarts = 1'",
            "edit results/head-data/study.toml 'size = 5' 'size = 9'",
        ),
        "one short subject for ten, 20 replicates for 200, a LASSO that ends sooner",
    ),
    ("docs/selection.md", "impc select results/head-data/study.toml --out results/select"): Smaller(
        ("impc select results/head-data/study.toml --out results/select --workers 1 --yes",),
        "one worker to start, whatever the cores, and no question how long a busy machine takes",
    ),
    (
        "docs/selection.md",
        "impc simulate head-tracking --subjects 40 --visits 2 --out results/head-data-2",
    ): Smaller(
        (
            "impc simulate head-tracking --subjects 2 --visits 2 --trials 1 --duration 6"
            " --out results/head-data-2",
            "edit results/head-data-2/study.toml 'replicates = 200' 'replicates = 20\nstarts = 1'",
        ),
        "two short subjects for forty",
    ),
    (
        "docs/selection.md",
        "impc key-parameters results/head-data-2/study.toml --out results/key",
    ): Smaller(
        (
            "impc key-parameters results/head-data-2/study.toml --out results/key"
            " --bound 0.03 --workers 1 --yes",
        ),
        "fewer subsets to refit: 0.03 is below the default bound; no question how long it takes",
    ),
}

#: page -> lines that make the files which the page supposes its reader to have.
PREPARED = {
    "docs/fitting.md": _HERE,
    "docs/recordings.md": (*_HERE, "rm subject.toml"),
    "docs/comparing.md": _HERE,
}
