"""Fits run in turn in processes of their own, stop, go on, and are never left behind."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest

from impc.app.fits import Fit, Fits, State
from impc.jit import cache_home
from impc.reporting.writer import owned
from tests.app.serving import PATIENCE, ROOT, Client, serving


def until(wanted: Callable[[], object]) -> None:
    """Wait; the time is only a limit for a test that hangs."""
    end = time.monotonic() + PATIENCE
    while not wanted():
        assert time.monotonic() < end
        time.sleep(0.05)


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    return tmp_path


def asked(fits: Fits, folder: Path) -> Fit:
    out = folder / "fit-1"
    fits.start(("impc", "fit", "--config", str(folder / "none.toml"), "--out", str(out)), out)
    found = fits.of(folder)
    assert found is not None
    return found


def test_a_refused_fit_says_why(home: Path) -> None:
    fit = asked(Fits(), home)
    until(lambda: fit.over)
    assert fit.state is State.REFUSED
    assert "none.toml: does not exist" in fit.said


def test_fits_of_other_windows_come_first(home: Path) -> None:
    (home / "a").mkdir()
    (home / "b").mkdir()
    fits = Fits()
    with owned(cache_home() / "impc" / "fits", "app"):  # a fit of another server
        first, second = asked(fits, home / "a"), asked(fits, home / "b")
        assert (fits.before(first), fits.before(second)) == (0, 1)
        assert first.state is State.WAITING
        second.stop()
        assert asked(fits, home / "a") is first  # not twice
    until(lambda: second.over)
    assert (first.state, second.state) == (State.REFUSED, State.STOPPED)
    assert second.began == 0.0  # it never began


def practice(client: Client) -> None:
    assert client.post("practise", {}).status == 303
    assert "trial_1.csv" in client.get("recordings", f="practice").text


@pytest.mark.full
@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGKILL])
def test_no_fit_is_left_behind(how: signal.Signals, tmp_path: Path) -> None:
    if signal.getsignal(how) == signal.SIG_IGN:
        pytest.skip("it is ignored here, as under nohup, and the server goes on")
    folder = tmp_path / "study"
    folder.mkdir()
    with serving(folder) as client:
        practice(client)
        client.post("fit", {}, f="practice")
        until(lambda: "inverse MPC</li>" in client.get("fit", f="practice").text)
        children = psutil.Process(client.process.pid).children(recursive=True)
        fits = [one for one in children if "fit" in one.cmdline()]
        assert fits
        client.process.send_signal(how)
        client.process.wait(30)
        _, alive = psutil.wait_procs(fits, timeout=PATIENCE)
        assert not alive
    with serving(folder) as client:
        assert "Go on" in client.get("fit", f="practice").text
