"""The page of `impc inspect` names each column, its meaning and its question, and draws all."""

from __future__ import annotations

import io
import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from impc.cli.main import main


def test_every_column_is_drawn_and_each_question_has_its_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    time = np.arange(900) / 100
    columns = {"Zeit [s]": time, "Sitz [Grad]": np.sin(time), "theta2 [deg]": np.cos(time),
               "<b>Stoß [N*m]": np.sign(np.sin(9 * time)),
               "Sync [V]": np.where((time >= 2) & (time < 2.1), 5.0, 0.0)}  # fmt: skip
    (tmp_path / "a.csv").write_text(pd.DataFrame(columns).to_csv(index=False), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    opened: list[str] = []
    monkeypatch.setattr("click.launch", opened.append)
    with pytest.raises(SystemExit) as ended:
        main(["inspect", "a.csv", "--plant", "seated-balance", "--open"])
    assert ended.value.code == 0
    assert opened == [str(Path("results/inspect/report.html"))]
    text = (tmp_path / "results/inspect/signals.csv").read_bytes().decode()
    table = pd.read_csv(io.StringIO(text)).fillna("").set_index("column")
    assert dict(table.taken_for) == {
        "Zeit": "time", "Sitz": "theta1", "theta2": "theta2", "<b>Stoß": "perturbation",
        "": "start of the trial", "Sync": "not used",
    }  # fmt: skip
    assert table.line_of_its_answer[""] == "[recording] start = 2"
    assert "gon" in table.question["Sitz"]
    assert table.question["theta2"] == ""
    assert table.line_of_its_answer["Sitz"] == '[signals.theta1] column = "Sitz", unit = "?"'
    page = opened and (tmp_path / opened[0]).read_text(encoding="utf-8")
    assert page
    assert "<b>Sto" not in page
    drawn = re.search(r'<script type="application/json"[^>]*>(.*?)</script>', page, re.S)
    assert drawn is not None
    (trial,) = json.loads(drawn[1])["trials"]
    assert trial["step"] == pytest.approx(0.01)
    for panel, values in zip(trial["panels"], list(columns.values())[1:], strict=True):
        np.testing.assert_allclose(panel["curves"][0], values, rtol=1e-4, atol=1e-9)
