"""Rows of text that fit where they go: one line each into a pipe, wrapped to the width of a terminal."""

from __future__ import annotations

import shutil
import sys
import textwrap
from collections.abc import Sequence


def terminal_width() -> int | None:
    """Columns of the terminal that stdout is, None if it is none."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else None


def rows_of(cells: Sequence[Sequence[str]], notes: Sequence[str], *, width: int | None) -> list[str]:
    """Rows of cells in columns, with a note each.

    The note stands at the end of its row; if one of them does not fit there, every one stands in lines of its own
    below its row, indented. No line ends in spaces.

    Args:
        cells: one list per row, all equally long.
        notes: one per row, may be empty.
        width: most columns of a line; None for no limit.
    """
    if not cells:
        return []
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    heads = ["  ".join(f"{c:<{w}}" for c, w in zip(row, widths, strict=True)) for row in cells]
    beside = [f"{head}  {note}".rstrip() for head, note in zip(heads, notes, strict=True)]
    if width is None or max(map(len, beside)) <= width:
        return beside
    lines = []
    for head, note in zip(heads, notes, strict=True):
        lines.append(head.rstrip())
        lines += textwrap.wrap(note, max(20, width), initial_indent="    ", subsequent_indent="    ")
    return lines
