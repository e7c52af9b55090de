"""Tables as text: Markdown that reads well unrendered, and LaTeX with booktabs."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

Format = Literal["markdown", "latex"]
Style = Literal["plain", "bold", "underline", "italic"]

MISSING = "–"
"""What stands in a cell without a value."""

_SUPERSCRIPTS = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")
_LATEX = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    "&": r"\&",
    "%": r"\%",
    "$": r"\$",
    "#": r"\#",
    "_": r"\_",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': r"\textquotedbl{}",
    "–": "--",
    "−": "$-$",
    "×": r"$\times$",
    "✓": r"$\checkmark$",
    "✗": r"$\times$",
    "σ": r"$\sigma$",
    "δ": r"$\delta$",
    "±": r"$\pm$",
    "…": r"\ldots{}",
}


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


def text_table(titles: Sequence[str], rows: Sequence[Sequence[str]], text_columns: int = 1) -> TextTable:
    """A table of plain strings whose first ``text_columns`` columns are flush left and the others right."""
    numeric = [i >= text_columns for i in range(len(titles))]
    return TextTable(list(titles), numeric, [[Cell(text) for text in row] for row in rows])


def escape_latex(text: str) -> str:
    """Text that LaTeX sets as it stands here, but for line breaks, which become spaces."""
    return "".join(_LATEX.get(sign, sign) for sign in re.sub(r"\s+", " ", text))


def _markdown_text(text: str) -> str:
    # Underscores between letters and digits are literal in GitHub's Markdown; stars and angle brackets are not.
    return re.sub(r"([*|<>\\`])", r"\\\1", re.sub(r"\s+", " ", text))


def _markdown_cell(cell: Cell) -> str:
    text = _markdown_text(cell.text)
    if cell.style == "italic" and text:
        text = f"*{text}*"
    return text + ("" if cell.note is None else str(cell.note).translate(_SUPERSCRIPTS))


def _markdown(table: TextTable) -> str:
    titles = [_markdown_text(title) for title in table.titles]
    rows = [row if isinstance(row, Heading) else [_markdown_cell(cell) for cell in row] for row in table.rows]
    cells = [titles] + [row for row in rows if not isinstance(row, Heading)]
    widths = [max(3, *(len(row[i]) for row in cells)) for i in range(len(titles))]

    def line(row: Sequence[str]) -> str:
        padded = [
            text.rjust(width) if numeric else text.ljust(width)
            for text, width, numeric in zip(row, widths, table.numeric, strict=True)
        ]
        return f"| {' | '.join(padded)} |"

    rule = [
        "-" * (width - 1) + ":" if right else "-" * width
        for width, right in zip(widths, table.numeric, strict=True)
    ]
    lines = [f"**{_markdown_text(table.caption)}**", ""] if table.caption else []
    lines += [line(titles), line(rule)]
    for row in rows:
        if isinstance(row, Heading):
            # GitHub fills up short rows, so the heading may run across the columns after it.
            start = "".join(f"| {' ' * width} " for width in widths[: table.heading_column])
            head = f"{start}| *{_markdown_text(row.text)}*"
            lines.append(f"{head.ljust(len(lines[-1]) - 2)} |")
        else:
            lines.append(line(row))
    for text in (
        f"{str(number).translate(_SUPERSCRIPTS)} {note}" for number, note in enumerate(table.notes, 1)
    ):
        lines += ["", _markdown_text(text)]
    for remark in table.remarks:
        lines += ["", _markdown_text(remark)]
    return "\n".join(lines) + "\n"


def _latex_cell(cell: Cell) -> str:
    text = escape_latex(cell.text)
    command = {"bold": "textbf", "underline": "underline", "italic": "textit", "plain": None}[cell.style]
    if command and text:
        text = f"\\{command}{{{text}}}"
    # Notes hang out to the right, so that numbers stay aligned.
    return text + ("" if cell.note is None else f"\\rlap{{\\textsuperscript{{{cell.note}}}}}")


def _latex(table: TextTable) -> str:
    count = len(table.titles)
    columns = "".join("r" if right else "l" for right in table.numeric)
    body: list[list[str] | str] = []
    for i, row in enumerate(table.rows):
        if isinstance(row, Heading):
            span = count - table.heading_column
            across = f"\\multicolumn{{{span}}}{{l}}{{\\textit{{{escape_latex(row.text)}}}}}"
            body += ["\\midrule"] if i else []
            body += [f"{'& ' * table.heading_column}{across} \\\\", "\\midrule"]
        else:
            body.append([_latex_cell(cell) for cell in row])
    # Titles of numbers are centred over them.
    titles = [
        f"\\multicolumn{{1}}{{c}}{{{escape_latex(title)}}}" if right else escape_latex(title)
        for title, right in zip(table.titles, table.numeric, strict=True)
    ]
    cells = [row for row in body if not isinstance(row, str)]
    widths = [max([len(row[i]) for row in cells], default=0) for i in range(count)]
    lines = [
        "% Needs \\usepackage{booktabs,amssymb}",
        "\\begin{table}",
        "  \\centering",
        "  \\scriptsize",
        "  \\setlength{\\tabcolsep}{3pt}",
    ]
    if table.caption:
        lines.append(f"  \\caption{{{escape_latex(table.caption)}}}")
        lines.append(f"  \\label{{tab:{table.key}}}")
    lines += [
        f"  \\begin{{tabular}}{{{columns}}}",
        "    \\toprule",
        f"    {' & '.join(titles)} \\\\",
        "    \\midrule",
    ]
    for entry in body:
        if isinstance(entry, str):
            lines.append(f"    {entry}")
        else:
            padded = [
                text.rjust(width) if right else text.ljust(width)
                for text, width, right in zip(entry, widths, table.numeric, strict=True)
            ]
            lines.append(f"    {' & '.join(padded)} \\\\")
    lines += ["    \\bottomrule", "  \\end{tabular}"]
    if table.notes or table.remarks:
        lines.append("  \\par\\smallskip\\raggedright")
        lines += [
            f"  \\textsuperscript{{{number}}}~{escape_latex(note)}\\par"
            for number, note in enumerate(table.notes, 1)
        ]
        lines += [f"  {escape_latex(remark)}\\par" for remark in table.remarks]
    lines.append("\\end{table}")
    return "\n".join(lines) + "\n"
