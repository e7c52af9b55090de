"""How far the probabilities of a run can be trusted, against the ground truth."""

from collections.abc import Sequence
from typing import Any

import torch

from foundpose.bop import BopDataset, Target
from foundpose.bop.localization import tabulate
from foundpose.bop.scoring import model_errors
from foundpose.evaluation.records import to_results
from foundpose.pipeline import RIGHT_PIXELS, Reliability, reliability


def dataset_reliability(dataset: BopDataset, records: Sequence[dict[str, Any]]) -> Reliability | None:
    """Compare the probabilities of records with which poses are right, by the nearest annotation of the object.

    Args:
        dataset: with ground truth and models for evaluation.
        records: estimates, as :func:`foundpose.evaluation.records.pose_records` with ids.

    Returns:
        Of the poses that were found; None where there are none, or no probabilities.
    """
    records = [record for record in records if record["valid"] and "probability" in record]
    if not records:
        return None
    results = to_results(records)
    keys = sorted({(result.scene_id, result.im_id, result.obj_id) for result in results})
    tables = tabulate(dataset, results, [Target(*key, len(results)) for key in keys], all_estimates=True)
    right = torch.zeros(len(results), dtype=torch.bool)
    if tables.annotations.shape[1]:
        nearest = model_errors(dataset, tables, ["mspd"])["mspd"].amin(dim=2)
        used = tables.estimates >= 0
        right[tables.estimates[used]] = (nearest < RIGHT_PIXELS)[used]
    return reliability(torch.tensor([record["probability"] for record in records]), right)
