"""Body, limit and foresight on the page: parameters of the plant, and settings of the fit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from impc.app.subject import number, value_at
from impc.files.configuration import FILL_IN
from impc.files.plant_sources import UNCERTAINTY

if TYPE_CHECKING:
    from collections.abc import Mapping

    from impc.app.subject import Subject
    from impc.files.plant_sources import Parameter

#: Horizon in samples without another answer.
HORIZON = 20


@dataclass(frozen=True)
class Row:
    """A parameter of the plant with its answer."""

    parameter: Parameter
    value: str  # Empty if the plant's own value is used
    open: bool  # Whether an answer is asked for
    deviation: str  # The user's own; empty for that of the plant

    @property
    def usual(self) -> str:
        """The plant's value."""
        value = self.parameter.value
        return f"{value:.5g}" if isinstance(value, float) else str(value)


def rows(subject: Subject) -> list[Row]:
    """Arguments and physical parameters of the plant."""
    given = subject.content.get("plant", {})
    stated = given.get(UNCERTAINTY, {})
    found = []
    for one in subject.source.parameters():
        value = given.get(one.name, "")
        asked = value == FILL_IN
        deviation = stated.get(one.name, "")
        found.append(Row(one, "" if asked else f"{value}", asked, f"{deviation}"))
    return found


def answers(form: Mapping[str, str], subject: Subject) -> dict[tuple[str, ...], Any]:
    """Changes of subject.toml by the fields of the page; an empty field is no answer yet."""
    found: dict[tuple[str, ...], Any] = {}
    content = subject.content
    for row in rows(subject):
        one, text = row.parameter, form.get(f"plant.{row.parameter.name}", "").strip()
        value: Any = text or None
        if not one.choices and not isinstance(one.value, str):
            value = number(text, one.words)
            if isinstance(one.value, int) and value is not None and value == int(value):
                value = int(value)
        typical = f"typical.{one.name}" in form
        if value is not None or not row.open or typical:
            found["plant", one.name] = value
        deviation = form.get(f"sd.{one.name}", "").strip().replace(",", ".")
        exact = deviation if "%" in deviation else number(deviation, f"uncertainty, {one.words}")
        found["plant", UNCERTAINTY, one.name] = exact or None
    limit = number(form.get("u_max", ""), "largest command", 0.0)
    unlimited = "no_limit" in form
    found["fit", "u_max"] = None if unlimited else FILL_IN if limit is None else limit
    horizon = number(form.get("horizon", ""), "horizon", 0.0) or HORIZON
    found["fit", "horizon"] = int(horizon)
    return {key: new for key, new in found.items() if new != value_at(content, key)}
