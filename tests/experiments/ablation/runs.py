"""Records of made-up runs."""

from typing import Any

from ablation import RunRecord, paper_datasets

TARGETS = {dataset.name: dataset.targets for dataset in paper_datasets()}


def row_run(row: str, dataset: str, AR: float | None = None, **facts: Any) -> RunRecord:
    """A run of a row of the paper on all targets of a dataset."""
    figures = {"AR": AR, "AR_VSD": AR, "AR_MSSD": AR, "AR_MSPD": AR, "targets": TARGETS.get(dataset)}
    figures |= facts.pop("figures", {})
    return RunRecord(row, row, dataset, facts.pop("status", "finished"), figures=figures, **facts)


def sweep_run(settings: dict[str, Any], figures: dict[str, Any], **facts: Any) -> RunRecord:
    """A run of a sweep on LM-O."""
    facts = {"name": "sweep", "row": None, "dataset": "lmo", "status": "finished"} | facts
    return RunRecord(**facts, settings=settings, figures=figures)


def markdown_rows(text: str) -> list[list[str]]:
    """Cells of all lines of a Markdown table, headings and rule too."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
