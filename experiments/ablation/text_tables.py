"""Tables as text, set by pandas: Markdown that reads well unrendered, and LaTeX with booktabs."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import pandas as pd

Format = Literal["markdown", "latex"]
Style = Literal["plain", "bold", "underline", "italic"]

MISSING = "–"
"""What stands in a cell without a value."""

_SUPERSCRIPTS = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")
_COMMANDS = {"bold": "textbf", "underline": "underline", "italic": "textit"}
_LATEX = str.maketrans(
    {sign: f"\\{sign}" for sign in "{}&%$#_"}
    | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    | {"<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}", '"': r"\textquotedbl{}"}
    | {"–": "--", "−": "$-$", "×": r"$\times$", "✓": r"$\checkmark$", "✗": r"$\times$"}
    | {"σ": r"$\sigma$", "δ": r"$\delta$", "±": r"$\pm$", "…": r"\ldots{}"}
)


@dataclass(frozen=True)
class Cell:
    """Text of a cell.

    Attributes:
        text: plain; signs that mean something to a format are escaped.
        note: number of the note that belongs to it, or None.
        style: how it is set. Markdown only knows italic here, so that numbers stay aligned.
    """

    text: str
    note: int | None = None
    style: Style = "plain"


@dataclass(frozen=True)
class Heading:
    """A line across the table, over the rows of a section."""

    text: str


@dataclass
class TextTable:
    """A table to be rendered.

    Attributes:
        titles: of the columns.
        numeric: which columns are set flush right.
        rows: cells and headings from top to bottom.
        notes: below the table, numbered from 1.
        remarks: below the notes, on the table as a whole.
        caption: in LaTeX; over the table in Markdown.
        key: of the LaTeX label (``tab:<key>``).
        heading_column: where headings start.
    """

    titles: list[str]
    numeric: list[bool]
    rows: list[list[Cell] | Heading] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    caption: str = ""
    key: str = "results"
    heading_column: int = 0

    def note(self, text: str | None) -> int | None:
        """Number of a note, None for none; the same text gets the same number."""
        if text is None:
            return None
        if text not in self.notes:
            self.notes.append(text)
        return self.notes.index(text) + 1

    def render(self, format: Format) -> str:
        """The table as text that ends with a line break.

        Raises:
            ValueError: unknown format, or a row with another number of cells than there are columns.
        """
        for row in self.rows:
            if not isinstance(row, Heading) and len(row) != len(self.titles):
                raise ValueError(f"a row has {len(row)} cells, the table {len(self.titles)} columns")
        if format == "markdown":
            return _markdown(self)
        if format == "latex":
            return _latex(self)
        raise ValueError(f"format must be markdown or latex, got {format!r}")

    def frame(self, cell: Callable[[Cell], str], heading: Callable[[str], str]) -> pd.DataFrame:
        """The rows as text, by what sets a cell and what sets a heading."""
        blank = [""] * len(self.titles)
        lines = [
            blank.copy() if isinstance(row, Heading) else [cell(each) for each in row] for row in self.rows
        ]
        for line, row in zip(lines, self.rows, strict=True):
            if isinstance(row, Heading):
                line[self.heading_column] = heading(row.text)
        return pd.DataFrame(lines, columns=self.titles, dtype=str)


def text_table(titles: Sequence[str], rows: Sequence[Sequence[str]], text_columns: int = 1) -> TextTable:
    """A table of plain strings whose first ``text_columns`` columns are flush left and the others right."""
    numeric = [i >= text_columns for i in range(len(titles))]
    return TextTable(list(titles), numeric, [[Cell(text) for text in row] for row in rows])


def escape_latex(text: str) -> str:
    """Text that LaTeX sets as it stands here, but for line breaks, which become spaces."""
    return re.sub(r"\s+", " ", text).translate(_LATEX)


def _markdown_text(text: str) -> str:
    # Underscores between letters and digits are literal in GitHub's Markdown; stars and angle brackets are not.
    return re.sub(r"([*|<>\\`])", r"\\\1", re.sub(r"\s+", " ", text))


def _markdown_cell(cell: Cell) -> str:
    text = _markdown_text(cell.text)
    if cell.style == "italic" and text:
        text = f"*{text}*"
    return text + ("" if cell.note is None else str(cell.note).translate(_SUPERSCRIPTS))


def _markdown(table: TextTable) -> str:
    body = table.frame(_markdown_cell, lambda text: f"*{_markdown_text(text)}*").to_markdown(
        index=False,
        headers=[_markdown_text(title) for title in table.titles],
        colalign=["right" if numeric else "left" for numeric in table.numeric],
        disable_numparse=True,  # "12.0" stays "12.0"
    )
    notes = [f"{str(number).translate(_SUPERSCRIPTS)} {note}" for number, note in enumerate(table.notes, 1)]
    below = [_markdown_text(text) for text in [*notes, *table.remarks]]
    above = [f"**{_markdown_text(table.caption)}**"] if table.caption else []
    return "\n\n".join([*above, body, *below]) + "\n"


def _latex_cell(cell: Cell) -> str:
    text = escape_latex(cell.text)
    if cell.style in _COMMANDS and text:
        text = f"\\{_COMMANDS[cell.style]}{{{text}}}"
    # Notes hang out to the right, so that numbers stay aligned.
    return text + ("" if cell.note is None else f"\\rlap{{\\textsuperscript{{{cell.note}}}}}")


def _latex(table: TextTable) -> str:
    span = len(table.titles) - table.heading_column
    body = table.frame(
        _latex_cell, lambda text: f"\\multicolumn{{{span}}}{{l}}{{\\textit{{{escape_latex(text)}}}}}"
    )
    body.columns = [  # titles of numbers are centred over them
        f"\\multicolumn{{1}}{{c}}{{{escape_latex(title)}}}" if numeric else escape_latex(title)
        for title, numeric in zip(table.titles, table.numeric, strict=True)
    ]
    columns = "".join("r" if numeric else "l" for numeric in table.numeric)
    text = body.to_latex(index=False, escape=False, column_format=columns)
    # A heading fills its line, between rules.
    text = re.sub(r"(?m)^(.*\{l\}\{\\textit\{.*?)[ &]*\\\\$", r"\\midrule\n\1 \\\\\n\\midrule", text)
    text = text.replace("\\midrule\n\\midrule\n", "\\midrule\n")
    lines = ["% Needs \\usepackage{booktabs,amssymb}", "\\begin{table}", "\\centering", "\\scriptsize"]
    lines.append("\\setlength{\\tabcolsep}{3pt}")
    if table.caption:
        lines += [f"\\caption{{{escape_latex(table.caption)}}}", f"\\label{{tab:{table.key}}}"]
    lines.append(text.rstrip())
    if table.notes or table.remarks:
        lines.append("\\par\\smallskip\\raggedright")
        lines += [
            f"\\textsuperscript{{{number}}}~{escape_latex(note)}\\par"
            for number, note in enumerate(table.notes, 1)
        ]
        lines += [f"{escape_latex(remark)}\\par" for remark in table.remarks]
    return "\n".join([*lines, "\\end{table}"]) + "\n"
