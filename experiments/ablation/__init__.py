"""Ablations: the paper's numbers, records of runs, and the tables and plots made of both.

``runs.py`` runs settings and writes the reports (``experiments/ablate.py``); the rest knows records of runs only.
"""

from ablation.memory import memory_table, paper_memory, recorded_memory
from ablation.paper import (
    PaperDataset,
    PaperRow,
    PaperSection,
    PaperTable,
    find_paper_row,
    paper_datasets,
    paper_numbers,
    read_paper_table,
)
from ablation.plots import plot_sweep
from ablation.records import RunRecord, collect_runs, tidy, varied_settings, write_tidy
from ablation.runs import SweepReport, run_once, write_reports
from ablation.sweeps import SWEEP_FIGURES, sweep_table
from ablation.tables import paper_table

__all__ = [
    "SWEEP_FIGURES",
    "PaperDataset",
    "PaperRow",
    "PaperSection",
    "PaperTable",
    "RunRecord",
    "SweepReport",
    "collect_runs",
    "find_paper_row",
    "memory_table",
    "paper_datasets",
    "paper_memory",
    "paper_numbers",
    "paper_table",
    "plot_sweep",
    "read_paper_table",
    "recorded_memory",
    "run_once",
    "sweep_table",
    "tidy",
    "varied_settings",
    "write_reports",
    "write_tidy",
]
