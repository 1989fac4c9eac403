"""A workbook of plain tables (.xlsx): every Excel opens it, whatever its decimal sign.

Written here and not by a library: of Office Open XML (ECMA-376, part 1) a table of numbers and
words needs four small files and two kinds of cells.
"""

from __future__ import annotations

import io
import math
import zipfile
from html import escape
from numbers import Real
from typing import TYPE_CHECKING, Any

from impc.files.headings import written_heading

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from impc.files.table import Table

_LONGEST_NAME = 31  # characters of a sheet's
_FORBIDDEN = str.maketrans("[]:*?/\\'", "________")
_MAIN = "http://schemas.openxmlformats.org/spreadsheetml/2006/main"
_LINKS = "http://schemas.openxmlformats.org/package/2006/relationships"
_OFFICE = "http://schemas.openxmlformats.org/officeDocument/2006/relationships"
_KIND = "application/vnd.openxmlformats-officedocument.spreadsheetml"
_HEAD = '<?xml version="1.0" encoding="UTF-8" standalone="yes"?>\n'


def workbook_bytes(sheets: Mapping[str, tuple[Sequence[str], Iterable[Sequence[Any]]]]) -> bytes:
    """The bytes of a workbook of `sheets`; numbers keep all their digits.

    By name, of at most 31 signs: heads, and the cells of each row. None and what is not finite are
    empty cells.
    """
    names = [escape(name.translate(_FORBIDDEN)[:_LONGEST_NAME]) for name in sheets]
    places = range(1, len(names) + 1)
    files = {
        "[Content_Types].xml": _types(places),
        "_rels/.rels": _relations({"rId1": ("officeDocument", "xl/workbook.xml")}),
        "xl/workbook.xml": f'<workbook xmlns="{_MAIN}" xmlns:r="{_OFFICE}"><sheets>'
        + "".join(
            f'<sheet name="{name}" sheetId="{place}" r:id="rId{place}"/>'
            for place, name in zip(places, names, strict=True)
        )
        + "</sheets></workbook>",
        "xl/_rels/workbook.xml.rels": _relations(
            {f"rId{place}": ("worksheet", f"worksheets/sheet{place}.xml") for place in places}
        ),
        **{
            f"xl/worksheets/sheet{place}.xml": _sheet([heads, *rows])
            for place, (heads, rows) in zip(places, sheets.values(), strict=True)
        },
    }
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in files.items():
            # Without the time of day: the same tables are the same bytes.
            archive.writestr(zipfile.ZipInfo(name), _HEAD + text, zipfile.ZIP_DEFLATED)
    return content.getvalue()


def encode_workbook(table: Table) -> bytes:
    """The bytes of a workbook with one sheet, its headings with their units."""
    heads = [written_heading(name, table.units.get(name)) for name in table.columns]
    columns = [values.tolist() for values in table.columns.values()]
    return workbook_bytes({"recording": (heads, zip(*columns, strict=True))})


def _types(places: Iterable[int]) -> str:
    parts = {"/xl/workbook.xml": "sheet.main"}
    parts |= {f"/xl/worksheets/sheet{place}.xml": "worksheet" for place in places}
    overrides = "".join(
        f'<Override PartName="{part}" ContentType="{_KIND}.{kind}+xml"/>'
        for part, kind in parts.items()
    )
    return (
        '<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types">'
        '<Default Extension="rels" ContentType='
        '"application/vnd.openxmlformats-package.relationships+xml"/>'
        f'<Default Extension="xml" ContentType="application/xml"/>{overrides}</Types>'
    )


def _relations(targets: Mapping[str, tuple[str, str]]) -> str:
    entries = "".join(
        f'<Relationship Id="{name}" Type="{_OFFICE}/{kind}" Target="{target}"/>'
        for name, (kind, target) in targets.items()
    )
    return f'<Relationships xmlns="{_LINKS}">{entries}</Relationships>'


def _sheet(rows: Iterable[Sequence[Any]]) -> str:
    """Cells follow one another, so that none has to say where it stands."""
    lines = ("".join(map(_cell, row)) for row in rows)
    body = "".join(f"<row>{line}</row>" for line in lines)
    return f'<worksheet xmlns="{_MAIN}"><sheetData>{body}</sheetData></worksheet>'


def _cell(value: Any) -> str:
    if value is None:
        return "<c/>"
    if isinstance(value, Real) and not isinstance(value, bool):
        number = float(value)
        return f"<c><v>{number!r}</v></c>" if math.isfinite(number) else "<c/>"
    text = "".join(mark if mark.isprintable() else " " for mark in str(value))
    return f'<c t="inlineStr"><is><t xml:space="preserve">{escape(text)}</t></is></c>'
