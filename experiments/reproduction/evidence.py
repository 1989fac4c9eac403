"""Run the commands of the package once and read their `result.json`.

A command with a result is not run again, so `make reproduce` can be interrupted; delete the folder
to start again. The studies for `impc select`, `impc key-parameters` and `impc reliability` are
simulated (seed 0), because the dissertation's recordings are not public.
"""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from experiments.selection_claims import bootstrap_widths, reduced_widths
from impc.reporting.writer import write_files

__all__ = ["Evidence", "gather"]

TRIALS = ("trial_1.csv", "trial_2.csv", "trial_3.csv")


@dataclass(frozen=True)
class Evidence:
    """`result.json` of each command; `claims` come from `experiments.selection_claims`."""

    example: dict[str, Any]
    fit: dict[str, Any]
    reliability: dict[str, Any]
    select: dict[str, Any]
    yaw: dict[str, Any]
    pitch: dict[str, Any]
    claims: dict[str, Any]
    folder: Path


def gather(folder: Path) -> Evidence:
    """Run the commands without a result in `folder`; about half an hour on two cores."""
    subject = folder / "subject"
    _once(subject / "truth.json", ["simulate", "seated-balance", "--formats", "csv"])
    balance = folder / "balance"
    _once(balance / "truth.json", ["simulate", "reliability-study"])
    heads = {name: folder / f"heads-{name}" for name in ("ten", "yaw", "pitch")}
    tracking = ["simulate", "head-tracking"]
    forty = ["--subjects", "40", "--visits", "2"]
    _once(heads["ten"] / "truth.json", tracking)
    _once(heads["yaw"] / "truth.json", [*tracking, *forty])
    _once(heads["pitch"] / "truth.json", [*tracking, *forty, "--axis", "pitch"])
    recordings = [str(subject / name) for name in TRIALS]
    config = str(subject / "subject.toml")
    commands = {
        "example": ["example"],
        "fit": ["fit", *recordings, "--plant", "seated-balance", "--config", config],
        "reliability": ["reliability", str(balance / "study.toml")],
        "select": ["select", str(heads["ten"] / "study.toml")],
        "yaw": ["key-parameters", str(heads["yaw"] / "study.toml")],
        "pitch": ["key-parameters", str(heads["pitch"] / "study.toml")],
    }
    results = {
        name: json.loads(_once(folder / name / "result.json", line).read_text("utf-8"))
        for name, line in commands.items()
    }
    return Evidence(**results, claims=_claims(folder / "claims.json"), folder=folder)


def table(result: dict[str, Any], name: str) -> pd.DataFrame:
    """Table of one finding of a `result`."""
    return pd.DataFrame(result["findings"][name]["table"])


def _claims(path: Path) -> dict[str, Any]:
    """Widths of bootstrap intervals with 60 replicates, kept in a file."""
    if not path.exists():
        print("bootstrap intervals of chapter 4: ten minutes", flush=True)
        content = {
            "widths": [asdict(item) for item in bootstrap_widths(0.2, 0.6, 60)],
            "reduced": {name: list(item) for name, item in reduced_widths(60).items()},
        }
        write_files(path.parent, {path.name: (json.dumps(content, indent=1) + "\n").encode()})
    return dict(json.loads(path.read_text("utf-8")))


def _once(result: Path, line: list[str]) -> Path:
    """Run `impc <line> --out <folder of the result>` unless the result exists."""
    if not result.exists():
        given = [*line, "--out", str(result.parent)]
        print("impc", *given, flush=True)
        subprocess.run([Path(sys.executable).with_name("impc"), *given], check=True)
    return result
