"""Progress bar: messages after interruptions and lines without a bar."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest

from impc.cli.console import progress


@pytest.fixture(autouse=True)
def said(monkeypatch: pytest.MonkeyPatch) -> None:
    """Enable the progress output, which other tests disable."""
    monkeypatch.delenv("IMPC_QUIET")


def interrupted(*given: Any) -> None:
    with progress(*given) as done:
        done("a")
        done("b")
        raise KeyboardInterrupt


def test_an_interruption_says_how_much_is_kept() -> None:
    with pytest.raises(KeyboardInterrupt, match="2 of 9"):
        interrupted(9, "step", lambda count: f"{count} of 9")


def test_lines_stand_in_a_pipe_every_ten_seconds(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Simulated clock, 4 s per step; cached steps do not enter the estimate of the time left."""

    def clock() -> Iterator[float]:
        yield from range(0, 1000, 4)

    times = clock()
    monkeypatch.setattr("impc.cli.console.time.monotonic", lambda: next(times))
    with progress(8, "stage") as done:
        done("step 1", found=True)
        for step in range(2, 9):
            done(f"step {step}")
    assert capsys.readouterr().err.splitlines() == [
        "3 of 8 stages (step 3), about 30 s left",
        "6 of 8 stages (step 6), about 10 s left",
    ]


def test_a_program_reads_a_line_for_each_step(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also where the user has asked for quiet; simulated clock, 4 s per step."""
    monkeypatch.setenv("IMPC_PROGRESS", "json")
    monkeypatch.setenv("IMPC_QUIET", "1")
    times = iter(range(0, 1000, 4))
    monkeypatch.setattr("impc.cli.console.time.monotonic", lambda: next(times))
    with progress(4, "stage") as done:
        first = capsys.readouterr().err
        done("a", found=True)
        done("b")
        done("ü, c")
    heard = [json.loads(line) for line in (first + capsys.readouterr().err).splitlines()]
    steps = [("", None, False), ("a", None, True), ("b", None, False), ("ü, c", 6.0, False)]
    assert heard == [
        {"done": count, "total": 4, "title": title, "left": left, "found": found}
        for count, (title, left, found) in enumerate(steps)
    ]


def test_nothing_is_said_where_quiet_is_asked_for(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("IMPC_QUIET", "1")
    times = iter(range(0, 1000, 20))
    monkeypatch.setattr("impc.cli.console.time.monotonic", lambda: next(times))
    with progress(3, "step") as done:
        done("a")
    assert capsys.readouterr().err == ""
