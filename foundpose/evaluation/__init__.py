"""Evaluation of whole datasets with Lightning: batches, processes, resumption.

Imports pytorch_lightning, as only ``foundpose.training`` does besides.
"""

from foundpose.evaluation.data import InstanceBatches, Order, PoseBatch, PoseDataModule, plan_batches
from foundpose.evaluation.module import PoseEvaluation, estimate_dataset
from foundpose.evaluation.report import all_records, merge_shards, timing
from foundpose.evaluation.run import run_evaluation
from foundpose.evaluation.shards import BatchRecord, ShardWriter, read_shards

__all__ = [
    "BatchRecord",
    "InstanceBatches",
    "Order",
    "PoseBatch",
    "PoseDataModule",
    "PoseEvaluation",
    "ShardWriter",
    "all_records",
    "estimate_dataset",
    "merge_shards",
    "plan_batches",
    "read_shards",
    "run_evaluation",
    "timing",
]
