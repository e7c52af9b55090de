"""Targets for which nothing was found: listed by count and id, with the reason."""

import pytest
import torch

from foundpose.bop import PoseResult, Target
from foundpose.evaluation.report import in_words, unanswered


def result(im_id, obj_id):
    return PoseResult(1, im_id, obj_id, 0.5, torch.eye(4, dtype=torch.float64), 0.1)


def record(im_id, obj_id, status="OK"):
    return {"scene_id": 1, "im_id": im_id, "obj_id": obj_id, "status": status, "valid": status == "OK"}


def entry(im_id, obj_id, instances, reason):
    return {"scene_id": 1, "im_id": im_id, "obj_id": obj_id, "instances": instances, "reason": reason}


ONE, TWO = Target(1, 0, 5, 1), Target(1, 0, 6, 2)
ABSENT = "not in the results file"
IMAGE = Target(1, 3, None, None)

# targets, results, records, and what is missing
CASES = {
    "all there": ([ONE], [result(0, 5)], [record(0, 5)], []),
    "more than asked for": ([ONE], [result(0, 5)] * 3, [record(0, 5)] * 3, []),
    "no detection": ([ONE, TWO], [result(0, 5)], [record(0, 5)], [entry(0, 6, 2, "no detection")]),
    "of another image": ([ONE], [result(1, 5)], [record(1, 5)], [entry(0, 5, 1, "no detection")]),
    "of another object": ([ONE], [result(0, 6)], [record(0, 6)], [entry(0, 5, 1, "no detection")]),
    "too few": ([TWO], [result(0, 6)], [record(0, 6)], [entry(0, 6, 1, "too few detections")]),
    "no pose": (
        [ONE],
        [],
        [record(0, 5, "TOO_FEW_INLIERS"), record(0, 5, "NO_PATCHES")],
        [entry(0, 5, 1, "no pose (NO_PATCHES, TOO_FEW_INLIERS)")],
    ),
    "one of two": (
        [TWO],
        [result(0, 6)],
        [record(0, 6), record(0, 6, "UNUSABLE_MASK")],
        [entry(0, 6, 1, "no pose (UNUSABLE_MASK)")],
    ),
    "results file": (
        [ONE, TWO],
        [result(0, 6)],
        None,
        [entry(0, 5, 1, ABSENT), entry(0, 6, 1, ABSENT)],
    ),
    "image with estimates": ([IMAGE], [result(3, 5)], [record(3, 5)], []),
    "image without": ([IMAGE], [], [], [entry(3, None, 1, "no detection")]),
}


@pytest.mark.parametrize("name", CASES)
def test_what_is_missing_and_why(name):
    targets, results, records, expected = CASES[name]
    assert unanswered(targets, results, records) == expected


def test_in_words():
    assert in_words([]) == "every target has its estimates"
    missing = [entry(i, 5, 1, "no detection") for i in range(5)] + [entry(2, 6, 3, "no pose (NO_TEMPLATE)")]
    assert in_words(missing).splitlines() == [
        "5 instances without estimate, no detection: object 5 in image 0 of scene 1, object 5 in image 1 of scene 1, "
        "object 5 in image 2 of scene 1 and 2 more",
        "3 instances without estimate, no pose (NO_TEMPLATE): object 6 in image 2 of scene 1",
    ]
    assert "image 3 of scene 1" in in_words([entry(3, None, 1, "no detection")])
