import csv
import json
import re
import shutil
from pathlib import Path

import pytest

from foundpose.bop import check_times, read_results
from foundpose.evaluation.shards import shard_path
from tests.bop_dataset import make_bop_dataset
from tests.experiments.test_apps import SMALL, run_app
from tests.processes import finish, kill_when, start_app

ROOT = Path(__file__).resolve().parents[2]
NUM_IMAGES = 6
NAME = "oracle_tiny-test.csv"


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return make_bop_dataset(tmp_path_factory.mktemp("evaluation") / "tiny", images=NUM_IMAGES)


@pytest.fixture(scope="module")
def arguments(root, representations):
    return [
        "experiment=oracle",
        f"data.root={root}",
        *SMALL,
        f"representations={representations}",
        "trainer.accelerator=cpu",
        "data_module.batch_size=2",
        "report=null",
    ]


@pytest.fixture(scope="module")
def reference(arguments, tmp_path_factory):
    """A run left alone, of one process."""
    folder = tmp_path_factory.mktemp("reference")
    wanted = [argument for argument in arguments if argument != "report=null"]
    with pytest.MonkeyPatch.context() as monkeypatch:
        run_app(monkeypatch, "evaluate", *wanted, "report.figures=2", f"hydra.run.dir={folder}")
    return folder


def rows_without_times(path):
    return [line.split(",")[:-1] for line in path.read_text().splitlines()]


def test_the_report_has_every_instance_and_a_figure_of_the_worst(reference):
    page = (reference / "report.html").read_text(encoding="utf-8")
    found = re.search(r'<script id="data" type="application/json">(.*?)</script>', page, re.DOTALL)
    assert found is not None
    cases = json.loads(found[1])
    assert len(cases["rows"]) == len(cases["thumbnails"]) == NUM_IMAGES
    assert set(cases["figures"]) == {"0", "1"}
    assert {row["reason"] for row in cases["rows"]} == {"right"}
    errors = [row["MSPD / px"] for row in cases["rows"]]
    assert errors == sorted(errors, reverse=True)
    assert all(row["mask's overlap"] == 1 for row in cases["rows"])
    assert "Recall under MSSD" in page


def test_a_run_from_detections_to_scores(reference):
    results = read_results(reference / NAME)
    check_times(results)
    assert [(r.scene_id, r.im_id, r.obj_id) for r in results] == [
        (1, i, 1 + i % 2) for i in range(NUM_IMAGES)
    ]
    assert all(result.time > 0.25 for result in results)
    scores = json.loads((reference / "scores.json").read_text())
    assert scores["targets"] == NUM_IMAGES
    assert scores["mspd"]["AR"] > 0.9
    assert scores["mssd"]["AR"] > 0.9
    assert len(scores["mspd"]["recalls"]) == 10
    assert set(scores["mspd"]["objects"]) == {"1", "2"}
    timing = json.loads((reference / "timing.json").read_text())
    assert timing["instances"] == NUM_IMAGES
    assert timing["seconds"]["pnp"] > 0
    records = json.loads((reference / "estimates.json").read_text())
    assert [r["detection_score"] for r in records] == [0.9] * NUM_IMAGES


@pytest.mark.slow
def test_two_processes_share_the_work_and_agree_on_a_size(arguments, reference, tmp_path):
    """No instance is lost or done twice, and the results are those of one process."""
    changes = ["data_module.batch_size=auto", "trainer=ddp", "trainer.devices=2"]
    log = tmp_path / "log"
    printed = finish(start_app("evaluate", [*arguments, *changes, f"hydra.run.dir={tmp_path}"], log), log)
    size = json.loads((tmp_path / "batch_size.json").read_text())["batch_size"]
    assert size in (1, 2)  # every process gets a batch
    numbers = [
        [json.loads(line)["number"] for line in shard_path(tmp_path, rank).read_text().splitlines()]
        for rank in range(2)
    ]
    batches = list(range(NUM_IMAGES // size))
    assert numbers == [batches[::2], batches[1::2]]
    assert rows_without_times(tmp_path / NAME) == rows_without_times(reference / NAME)
    # One process wrote the results and printed the table.
    assert printed.count("AR_MSPD") == 1
    scores = [json.loads((folder / "scores.json").read_text()) for folder in (tmp_path, reference)]
    assert scores[0]["mspd"] == scores[1]["mspd"]


@pytest.mark.slow
def test_a_killed_run_goes_on(arguments, reference, root, tmp_path):
    """Kill it as soon as batches are there, twice; the end is that of the run left alone."""
    shard, log = shard_path(tmp_path, 0), tmp_path / "log"
    arguments = [*arguments, f"hydra.run.dir={tmp_path}"]

    def batches_done():
        return shard.read_bytes().count(b"\n") if shard.is_file() else 0

    for batches in (1, 2):
        kill_when(start_app("evaluate", arguments, log), lambda batches=batches: batches_done() >= batches)
        assert not (tmp_path / NAME).exists()
    # A line that the kill cut short.
    shard.write_bytes(shard.read_bytes() + b'{"number": 2, "rec')
    before = shard.read_bytes().splitlines()[:2]
    # The rest may be done by more processes.
    finish(start_app("evaluate", [*arguments, "trainer=ddp", "trainer.devices=2"], log), log)
    assert shard.read_bytes().splitlines()[:2] == before
    # A process for which nothing was left has no shard.
    lines = [line for path in shard.parent.glob("rank-*.jsonl") for line in path.read_text().splitlines()]
    assert sorted(json.loads(line)["number"] for line in lines) == [0, 1, 2]
    assert rows_without_times(tmp_path / NAME) == rows_without_times(reference / NAME)


def test_more_masks_than_instances(arguments, reference, tmp_path, monkeypatch, capsys):
    """Five masks for each instance, of which the best pose is handed in."""
    run_app(monkeypatch, "evaluate", *arguments, "masks.masks_per_instance=5", f"hydra.run.dir={tmp_path}")
    assert len(json.loads((tmp_path / "estimates.json").read_text())) == 2 * NUM_IMAGES
    assert len(read_results(tmp_path / NAME)) == NUM_IMAGES
    assert json.loads((tmp_path / "scores.json").read_text())["mspd"]["AR"] > 0.9
    assert "AR_MSPD" in capsys.readouterr().out


def test_a_part_is_scored_on_its_own_targets(arguments, tmp_path, monkeypatch):
    run_app(monkeypatch, "evaluate", *arguments, "objects=[2]", "max_images=4", f"hydra.run.dir={tmp_path}")
    scores = json.loads((tmp_path / "scores.json").read_text())
    assert scores["targets"] == len(read_results(tmp_path / NAME)) == 2
    assert scores["mspd"]["AR"] > 0.9


def test_scores_of_a_results_file(arguments, reference, tmp_path, monkeypatch, capsys):
    path = tmp_path / "submission_tiny-test.csv"
    with (reference / NAME).open(newline="") as file:
        rows = list(csv.reader(file))
    with path.open("w", newline="") as file:
        csv.writer(file).writerows(rows[:-3])
    run_app(monkeypatch, "evaluate", *arguments, f"results={path}", f"hydra.run.dir={tmp_path / 'run'}")
    scores = json.loads((tmp_path / "run" / "scores.json").read_text())
    whole = json.loads((reference / "scores.json").read_text())
    assert scores["target_instances_without_estimate"] == 3
    assert scores["mspd"]["AR"] == pytest.approx(whole["mspd"]["AR"] / 2, abs=0.05)
    assert not (tmp_path / "run" / "shards").exists()
    assert whole["without_estimate"] == []
    ids = [[int(number) for number in row[:3]] for row in rows[-3:]]
    missing = scores["without_estimate"]
    assert sorted([m["scene_id"], m["im_id"], m["obj_id"]] for m in missing) == sorted(ids)
    assert {(m["instances"], m["reason"]) for m in missing} == {(1, "not in the results file")}
    text = capsys.readouterr().out
    assert "AR_MSSD" in text
    assert "3 instances without estimate, not in the results file: object" in text


def test_a_test_set_without_ground_truth(arguments, root, reference, tmp_path, monkeypatch, capsys):
    copy = shutil.copytree(root, tmp_path / "tiny")
    for path in copy.glob("test/*/scene_gt*.json"):
        path.unlink()
    output = tmp_path / "run"
    run_app(
        monkeypatch,
        "evaluate",
        *arguments,
        f"data.root={copy}",
        "pictures=photographs",
        f"hydra.run.dir={output}",
    )
    assert "no scores: 1 of 1 scenes" in capsys.readouterr().out
    scores = json.loads((output / "scores.json").read_text())
    assert scores["computed"] is False
    assert "scene_gt.json" in scores["reason"]
    assert scores["without_estimate"] == []
    assert (output / NAME).is_file()


def test_targets_that_name_images_only(arguments, root, reference, tmp_path, monkeypatch):
    """bop24: every detection of an image is estimated; what there is to find follows from the ground truth."""
    copy = shutil.copytree(root, tmp_path / "tiny")
    targets = [{"scene_id": 1, "im_id": i} for i in range(NUM_IMAGES)]
    (copy / "test_targets_bop24.json").write_text(json.dumps(targets))
    output = tmp_path / "run"
    changes = [f"data.root={copy}", "data.targets=test_targets_bop24.json", f"hydra.run.dir={output}"]
    run_app(monkeypatch, "evaluate", *arguments, *changes)
    assert len(json.loads((output / "estimates.json").read_text())) == 2 * NUM_IMAGES
    scores = json.loads((output / "scores.json").read_text())
    assert scores["targets"] == NUM_IMAGES
    assert "6D detection" in scores["task"]
    detection = scores["detection_6d"]
    # The made-up detections beside the true ones find no pose.
    assert (detection["targets"], detection["estimates_counted"]) == (NUM_IMAGES, NUM_IMAGES)
    assert detection["objects"]["1"]["AP_MSPD"] == pytest.approx(scores["objects"]["1"]["AR_MSPD"], abs=0.01)
    assert scores["mspd"]["AR"] == json.loads((reference / "scores.json").read_text())["mspd"]["AR"]


def test_two_dimensional_detections(root, tmp_path, monkeypatch, capsys):
    """The made-up file holds the visible masks, empty ones of lower score, and boxes of one pixel."""
    changes = [
        f"data.root={root}",
        f"detections={root / 'detections' / 'cnos-fastsam'}",
        f"hydra.run.dir={tmp_path}",
    ]
    run_app(monkeypatch, "evaluate", *changes)
    scores = json.loads((tmp_path / "detection_scores.json").read_text())
    assert scores["targets"] == NUM_IMAGES
    assert "AP_segm  AP_bbox  AP_bbox_modal" in capsys.readouterr().out
    assert (scores["segm"]["AP"], scores["bbox"]["AP"]) == (pytest.approx(1.0), 0.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["results=none.csv"], "no results file at none.csv"),
        (["data_module.batch_size=0"], "batch_size must be at least 1, got 0"),
        (["errors=[mssd,iou]"], "iou"),
        (["masks.path=nowhere"], "nowhere"),
        (["objects=[9]"], "objects must be a list of ids from [1, 2]"),
        (["memory_limit=0.01"], "memory_limit is 0.01"),
        (["max_images=0"], "nothing to estimate"),
        (["pnp.iterations=50"], "holds a run with other settings"),
    ],
)
def test_bad_input_is_one_clear_line(arguments, reference, tmp_path, monkeypatch, capsys, change, message):
    output = tmp_path
    if change[0].startswith("pnp"):
        shutil.copy(reference / "settings.json", tmp_path)
    before = sorted(output.iterdir())
    with pytest.raises(SystemExit) as stop:
        run_app(monkeypatch, "evaluate", *arguments, *change, f"hydra.run.dir={output}")
    assert stop.value.code == 2
    error = capsys.readouterr().err.strip().splitlines()
    assert message in "\n".join(error[-40:])
    assert not (output / NAME).exists()
    assert set(before) <= set(output.iterdir())
