"""A report as one HTML file that needs no network: facts, tables, charts, and a table of cases with their figures."""

import base64
from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from jinja2 import Environment, PackageLoader, StrictUndefined
from PIL import Image

from foundpose.utils.files import write_text

if TYPE_CHECKING:  # pages without charts do without plotly
    import plotly.graph_objects as go

Cell = str | float | int | None


class Report(NamedTuple):
    """What a report shows.

    Attributes:
        title: of the page.
        facts: below the title, by name.
        tables: short ones by caption; a row holds cells by column.
        charts: figures of plotly by caption.
        cases: rows of the long table, which can be sorted and filtered, in their first order: worst first.
        thumbnails: pictures of cases, by place in ``cases``.
        figures: large pictures of cases, which a click on the row opens.
    """

    title: str
    facts: Mapping[str, str]
    tables: Mapping[str, Sequence[Mapping[str, Cell]]]
    charts: "Mapping[str, go.Figure]"
    cases: Sequence[Mapping[str, Cell]]
    thumbnails: Mapping[int, Image.Image]
    figures: Mapping[int, Image.Image]


def write_report(path: str | Path, report: Report) -> None:
    """Write a report, whole or not at all.

    The file takes 5 MB for plotly's own code, about 3 KB for a thumbnail and 60 KB for a figure.

    Args:
        path: of the HTML file.
        report: its content.
    """
    environment = Environment(
        loader=PackageLoader("foundpose.visualization", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    charts = {
        caption: chart.to_html(
            full_html=False, include_plotlyjs=False, config={"responsive": True, "displayModeBar": False}
        )
        for caption, chart in report.charts.items()
    }
    cases = {
        "columns": list(dict.fromkeys(name for case in report.cases for name in case)),
        "rows": [dict(case) for case in report.cases],
        "thumbnails": {place: _data_uri(picture) for place, picture in report.thumbnails.items()},
        "figures": {place: _data_uri(picture) for place, picture in report.figures.items()},
    }
    template = environment.get_template("report.html.j2")
    page = template.render(
        title=report.title,
        facts=report.facts,
        tables=report.tables,
        charts=charts,
        cases=cases,
        plotly=_plotly_code() if charts else "",
    )
    write_text(Path(path), page)


def lines_chart(x: Sequence[float], lines: Mapping[str, Sequence[float]], x_title: str) -> "go.Figure":
    """Lines over the same values, the first one thick; shares of 1 on the y axis."""
    import plotly.graph_objects as go

    figure = go.Figure(layout=_layout(x_title))
    for number, (name, y) in enumerate(lines.items()):
        width = 4 if number == 0 else 1.5
        figure.add_scatter(x=list(x), y=list(y), name=name, mode="lines+markers", line={"width": width})
    figure.update_yaxes(range=[0, 1.02], tickformat=".0%")
    return figure


def stacked_bars(counts: Mapping[str, Mapping[str, int]], x_title: str) -> "go.Figure":
    """Counts by kind (a colour each) and by place on the x axis, on top of each other."""
    import plotly.graph_objects as go

    figure = go.Figure(layout=_layout(x_title))
    for kind, by_place in counts.items():
        figure.add_bar(x=list(by_place), y=list(by_place.values()), name=kind)
    figure.update_layout(barmode="stack")
    figure.update_xaxes(type="category")
    return figure


def _layout(x_title: str) -> dict[str, object]:
    return {
        "template": "plotly_white",
        "height": 320,
        "margin": {"l": 50, "r": 10, "t": 10, "b": 45},
        "xaxis": {"title": x_title},
    }


def _plotly_code() -> str:
    from plotly.offline import get_plotlyjs

    code: str = get_plotlyjs()
    return code


def _data_uri(picture: Image.Image) -> str:
    buffer = BytesIO()
    picture.save(buffer, "WEBP", quality=80)
    return "data:image/webp;base64," + base64.b64encode(buffer.getvalue()).decode()
