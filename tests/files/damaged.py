"""Damaged recordings: each with a phrase of the one line in which it must end.

``DAMAGED[name].make(folder)`` writes the file and returns its path and the text of a configuration
for `PLANT`; ``DAMAGED[name].phrase`` must be said of it.
"""

from __future__ import annotations

from tests.files.damaged_files import DAMAGED_FILES
from tests.files.damaged_signals import DAMAGED_SIGNALS

__all__ = ["DAMAGED", "PLANT"]

#: The plant that the configurations are for, as the command line takes it.
PLANT = "plants:seated_balance_plant"

DAMAGED = {**DAMAGED_FILES, **DAMAGED_SIGNALS}
