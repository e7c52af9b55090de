import json

import numpy as np
import pytest
import torch
from pycocotools import mask as coco_mask

from foundpose.bop import (
    BopDataset,
    BopError,
    PoseResult,
    decode_rle,
    detected_instances,
    ground_truth_instances,
    read_results,
    write_results,
)


def test_run_lengths_are_column_major(rng):
    mask = rng.random((6, 9)) < 0.4
    flat = mask.flatten(order="F")
    edges = np.flatnonzero(np.diff(flat)) + 1
    counts = np.diff([0, *edges, flat.size]).tolist()
    counts = counts if not flat[0] else [0, *counts]
    assert torch.equal(decode_rle({"size": [6, 9], "counts": counts}), torch.from_numpy(mask))
    packed = coco_mask.encode(np.asfortranarray(mask.astype(np.uint8)))
    assert torch.equal(
        decode_rle({"size": [6, 9], "counts": packed["counts"].decode()}), torch.from_numpy(mask)
    )
    with pytest.raises(BopError, match="run lengths cover 3 pixels, the size says 6x9"):
        decode_rle({"size": [6, 9], "counts": [1, 2]})
    with pytest.raises(BopError, match="not a COCO run-length mask"):
        decode_rle({"counts": [1]})


def test_ground_truth_and_best_detections(tiny_bop):
    dataset = BopDataset(tiny_bop)
    truth = ground_truth_instances(dataset)
    path = tiny_bop / "detections" / "cnos-fastsam"
    best = detected_instances(dataset, path)
    assert [(i.scene_id, i.im_id, i.obj_id) for i in best] == [(i.scene_id, i.im_id, i.obj_id) for i in truth]
    assert all(i.score == 0.9 and i.time == 0.25 for i in best)
    for a, b in zip(truth, best, strict=True):
        assert torch.equal(a.mask(dataset), b.mask(dataset))
    several = detected_instances(dataset, path, masks_per_instance=5)
    assert [i.score for i in several] == [0.9, 0.4] * 3
    assert not several[1].mask(dataset).any()


def test_bad_detections(tiny_bop, tmp_path):
    dataset = BopDataset(tiny_bop)
    with pytest.raises(FileNotFoundError, match="is missing"):
        detected_instances(dataset, tmp_path / "none.json")
    with pytest.raises(FileNotFoundError, match="expected one JSON file"):
        detected_instances(dataset, tmp_path)
    (tmp_path / "bad.json").write_text(json.dumps([{"scene_id": 1, "image_id": 2}]))
    with pytest.raises(BopError, match="entry 0 lacks or misspells a field"):
        detected_instances(dataset, tmp_path / "bad.json")
    with pytest.raises(ValueError, match="masks_per_instance must be at least 1, got 0"):
        detected_instances(dataset, tmp_path / "bad.json", masks_per_instance=0)


def test_results_round_trip_and_one_time_per_image(tmp_path, generator):
    def result(im_id: int, time: float) -> PoseResult:
        T = torch.eye(4, dtype=torch.float64)
        T[:3] = torch.randn(3, 4, generator=generator, dtype=torch.float64) * 300
        return PoseResult(2, im_id, 5, 0.123456789, T, time)

    results = [result(3, 0.5), result(3, 0.7), result(4, -1.0)]
    path = tmp_path / "deep" / "results.csv"
    write_results(path, results)
    lines = path.read_text().splitlines()
    assert lines[0] == "scene_id,im_id,obj_id,score,R,t,time"
    assert len(lines[1].split(",")) == 7
    again = read_results(path)
    assert [r.time for r in again] == [0.7, 0.7, -1.0]
    for a, b in zip(results, again, strict=True):
        assert torch.allclose(a.T_camera_from_model, b.T_camera_from_model, rtol=1e-8)
        assert a.score == b.score
    path.write_text(lines[0] + "\n1,2,3,0.5,1 2 3,0 0 0,0.1\n")
    with pytest.raises(BopError, match="line 2: not a BOP result"):
        read_results(path)
    with pytest.raises(FileNotFoundError, match="no results file"):
        read_results(tmp_path / "none.csv")
