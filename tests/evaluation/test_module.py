import json
import shutil

import pytest
import pytorch_lightning as pl
import torch
from PIL import Image

import foundpose
import foundpose.utils.batch_size
import foundpose.utils.timing
from foundpose.bop import BopDataset, detected_instances, ground_truth_instances
from foundpose.bop.pictures import TrueCoordinates
from foundpose.evaluation.data import PoseDataModule
from foundpose.evaluation.module import PoseEvaluation, estimate_dataset
from foundpose.evaluation.objects import DatasetObjects
from foundpose.evaluation.records import to_results
from foundpose.evaluation.report import all_records, merge_shards, timing
from foundpose.evaluation.shards import shard_path
from foundpose.geometry import rotation_angle
from tests.bop_dataset import make_bop_dataset
from tests.experiments.test_apps import SMALL
from tests.pipeline.test_foundpose import make_pipeline

NUM_IMAGES = 5


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return make_bop_dataset(tmp_path_factory.mktemp("evaluation") / "tiny", images=NUM_IMAGES)


@pytest.fixture(scope="module")
def store(representations):
    """Objects as the apps' tests have them."""
    return foundpose.load(overrides=["experiment=oracle", *SMALL, f"representations={representations}"]).store


def both_detections(dataset):
    """Of each image an empty mask and the right one."""
    return detected_instances(dataset, dataset.root / "detections" / "cnos-fastsam", masks_per_instance=2)


def trainer(**changes):
    quiet = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False}
    return pl.Trainer(**(quiet | {"accelerator": "cpu", "devices": 1, "inference_mode": False} | changes))


def run(root, store, folder, masks=both_detections, memory_limit=None, **changes):
    dataset = BopDataset(root)
    objects = DatasetObjects(dataset, store, memory_limit)
    data = PoseDataModule(dataset, masks, objects, folder, TrueCoordinates(), **({"batch_size": 3} | changes))
    estimate_dataset(trainer(), PoseEvaluation(make_pipeline(), objects, folder), data)
    return data, objects, merge_shards(folder, data.batches)


@pytest.fixture(scope="module")
def detected(root, store, tmp_path_factory):
    """Folder, data module and batches of a run with detections, batches of three."""
    folder = tmp_path_factory.mktemp("detected")
    data, _, done = run(root, store, folder)
    return folder, data, done


@pytest.fixture(scope="module")
def truth(root, store, tmp_path_factory):
    """Records of a run with true masks, batches of four."""
    _, _, done = run(
        root, store, tmp_path_factory.mktemp("truth"), masks=ground_truth_instances, batch_size=4
    )
    return all_records(done)


@pytest.mark.parametrize("order", ["image", "object"])
def test_poses_of_a_dataset(root, store, tmp_path, order):
    _, objects, done = run(root, store, tmp_path, order=order)
    records = all_records(done)
    assert [(r["im_id"], r["obj_id"]) for r in records] == [
        (i, 1 + i % 2) for i in range(NUM_IMAGES) for _ in (0, 1)
    ]
    # The detector's scores and times are carried along; an empty mask has no pose and spoils no other.
    for record in records:
        assert record["valid"] == (record["detection_score"] == 0.9)
        assert record["status"] == ("OK" if record["valid"] else "UNUSABLE_MASK")
        assert record["time"] > 0.25
    dataset = BopDataset(root)
    results = to_results(records)
    assert len(results) == NUM_IMAGES
    for result in results:
        (truth,) = dataset.annotations(result.scene_id, result.im_id)
        R = truth.T_camera_from_model[:3, :3]
        assert torch.rad2deg(rotation_angle(result.T_camera_from_model[:3, :3], R)) < 3
    # An image's time: the detector's and all of its instances'.
    for im_id in range(NUM_IMAGES):
        first, second = (r for r in records if r["im_id"] == im_id)
        assert first["time"] == second["time"]
        assert first["time"] == pytest.approx(0.25 + first["seconds"] + second["seconds"])
    facts = timing(done, "cpu")
    stages = {"crop", "extractor", "retriever", "matcher", "pnp", "scorer", "other"}
    assert set(facts["seconds"]) == stages | {"pipeline", "waiting", "representations"}
    assert sum(facts["seconds"][name] for name in stages) == pytest.approx(facts["seconds"]["pipeline"])
    assert facts["seconds"]["pipeline"] == pytest.approx(sum(r["seconds"] for r in records))
    assert (facts["instances"], facts["images"], facts["batches"]) == (10, 5, 4)
    assert sorted(objects.loaded) == [1, 2]


def test_each_pose_is_that_of_its_instance_alone(root, store, truth, tmp_path):
    _, _, alone = run(root, store, tmp_path, masks=ground_truth_instances, batch_size=1)
    for a, b in zip(truth, all_records(alone), strict=True):
        T = torch.tensor(a["R"]), torch.tensor(b["R"])
        assert torch.rad2deg(rotation_angle(*T)) < 0.05
        assert a["templates"] == b["templates"]


def test_finished_batches_are_not_repeated(root, store, detected, tmp_path, monkeypatch):
    folder, data, done = detected
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    path = shard_path(tmp_path, 0)
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(lines[:2]) + lines[2][:100])
    read = []
    monkeypatch.setattr(BopDataset, "intrinsics", spy(BopDataset.intrinsics, read))
    _, _, again = run(root, store, tmp_path)
    touched = {(i.scene_id, i.im_id) for batch in data.batches[2:] for i in batch}
    assert {call[:2] for call in read} == touched
    assert [batch.number for batch in again] == [0, 1, 2, 3]
    assert path.read_bytes().splitlines(keepends=True)[:2] == lines[:2]
    for a, b in zip(done, again, strict=True):
        assert [without_times(r) for r in a.records] == [without_times(r) for r in b.records]
    # Nothing is left to do.
    before = path.read_bytes()
    run(root, store, tmp_path)
    assert path.read_bytes() == before


def spy(function, calls):
    def wrapped(self, *arguments):
        calls.append(arguments)
        return function(self, *arguments)

    return wrapped


def without_times(record):
    return {name: value for name, value in record.items() if name not in ("seconds", "time")}


def test_inference_does_not_touch_ground_truth(root, store, tmp_path, monkeypatch):
    """With everything about the truth gone from the disk, detections still get poses."""
    copy = shutil.copytree(root, tmp_path / "tiny")
    for path in copy.glob("test/*/scene_gt*.json"):
        path.unlink()
    for folder in ("mask", "mask_visib", "depth"):
        for path in copy.glob(f"test/*/{folder}"):
            shutil.rmtree(path)
    shutil.rmtree(copy / "models_eval", ignore_errors=True)
    dataset = BopDataset(copy)
    objects = DatasetObjects(dataset, store)
    data = PoseDataModule(dataset, both_detections, objects, tmp_path / "run", batch_size=4)
    # Photographs tell the oracle nothing: there are poses or not, but nothing fails.
    estimate_dataset(trainer(), PoseEvaluation(make_pipeline(), objects, tmp_path / "run"), data)
    assert len(all_records(merge_shards(tmp_path / "run", data.batches))) == 2 * NUM_IMAGES


def test_images_of_several_sizes_in_one_batch(root, store, truth, tmp_path):
    copy = shutil.copytree(root, tmp_path / "tiny")
    # Image 1 gets a margin on the right and below, which moves nothing.
    for folder, name in (("rgb", "000001.png"), ("mask_visib", "000001_000000.png")):
        path = copy / "test" / "000001" / folder / name
        with Image.open(path) as picture:
            larger = Image.new(picture.mode, (700, 500))
            larger.paste(picture)
        larger.save(path)
    _, _, done = run(copy, store, tmp_path / "a", masks=ground_truth_instances, batch_size=5)
    for a, b in zip(all_records(done), truth, strict=True):
        assert a["valid"]
        assert torch.rad2deg(rotation_angle(torch.tensor(a["R"]), torch.tensor(b["R"]))) < 0.05


def test_a_missing_batch_is_not_passed_over(detected, tmp_path):
    folder, data, _ = detected
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    path = shard_path(tmp_path, 0)
    path.write_bytes(b"".join(path.read_bytes().splitlines(keepends=True)[1:]))
    with pytest.raises(ValueError, match=r"1 of 4 batches are not in .* \(first: 0\)"):
        merge_shards(tmp_path, data.batches)


def test_nothing_to_estimate(root, store, tmp_path):
    with pytest.raises(ValueError, match=r"no instance of the objects \[2\] in the 1 images"):
        run(root, store, tmp_path, object_ids=[2], max_images=1)


def test_a_part_of_the_dataset(root, store, tmp_path):
    _, _, done = run(root, store, tmp_path, object_ids=[2], max_images=3)
    assert [(r["im_id"], r["obj_id"]) for r in all_records(done)] == [(1, 2), (1, 2)]


def test_memory_limit(root, store, tmp_path):
    dataset = BopDataset(root)
    everything = DatasetObjects(dataset, store)
    everything.onboard([1, 2])
    sizes = [everything.size(obj_id) for obj_id in (1, 2)]
    both = everything.representations([2, 1])
    assert [r.info.name for r in both] == ["tiny-000002", "tiny-000001"]
    assert sum(r.memory_bytes()["total"] for r in both) / 2**20 == pytest.approx(sum(sizes), rel=0.01)

    limited = DatasetObjects(dataset, store, memory_limit=max(sizes) * 1.1)
    first = limited.representations([1])[0]
    assert limited.loaded == [1]
    assert limited.representations([1])[0] is first
    limited.representations([2])
    assert limited.loaded == [2]
    assert limited.loaded_size() <= max(sizes)
    with pytest.raises(ValueError, match=r"objects \[1, 2\] of one batch take .* MiB, memory_limit is"):
        limited.representations([1, 2])
    with pytest.raises(ValueError, match="memory_limit must be positive"):
        DatasetObjects(dataset, store, memory_limit=0)

    # A run says so before it starts, and gets through when the batches are of one object each.
    with pytest.raises(ValueError, match="use order=object"):
        run(root, store, tmp_path / "a", memory_limit=max(sizes) * 1.1, batch_size=4)
    assert not shard_path(tmp_path / "a", 0).exists()
    data, objects, done = run(
        root, store, tmp_path / "b", memory_limit=max(sizes) * 1.1, batch_size=2, order="object"
    )
    assert len(done) == len(data.batches) == 5
    assert objects.loaded == [2]


def test_workers_read_the_same_batches(root, store, detected, tmp_path):
    _, data, done = detected
    again, _, done_again = run(root, store, tmp_path, num_workers=1)
    records = [[without_times(r) for r in all_records(batches)] for batches in (done, done_again)]
    assert json.dumps(records[0]) == json.dumps(records[1])
    assert again.batches == data.batches


def test_the_size_is_kept_in_the_folder_and_taken_from_there(root, store, truth, tmp_path, monkeypatch):
    tried = []
    monkeypatch.setattr(foundpose.utils.batch_size, "free_memory", lambda device: 10**12)
    estimate = PoseEvaluation.estimate

    def counted(self, batch, waiting=0.0):
        tried.append(len(batch.instances))
        return estimate(self, batch, waiting)

    monkeypatch.setattr(PoseEvaluation, "estimate", counted)
    data, _, done = run(root, store, tmp_path, masks=ground_truth_instances, batch_size="auto")
    assert tried[:3] == [1, 1, 2]
    assert json.loads((tmp_path / "batch_size.json").read_text()) == {"batch_size": 4}
    assert [len(batch) for batch in data.batches] == [4, 1]
    assert [without_times(r) for r in all_records(done)] == [without_times(r) for r in truth]

    # A run that goes on there has the same batches, however much memory there is now.
    (tmp_path / "batch_size.json").write_text('{"batch_size": 2}')
    (tmp_path / "shards" / "rank-00000.jsonl").unlink()
    tried.clear()
    monkeypatch.setattr(foundpose.utils.batch_size, "free_memory", lambda device: 0)
    data, _, _ = run(root, store, tmp_path, masks=ground_truth_instances, batch_size="auto")
    assert tried == [2, 2, 1]
    assert [len(batch) for batch in data.batches] == [2, 2, 1]


def test_a_size_that_is_not_known_yet(root, store, tmp_path):
    dataset = BopDataset(root)
    objects = DatasetObjects(dataset, store)
    data = PoseDataModule(dataset, ground_truth_instances, objects, tmp_path, batch_size="auto")
    with pytest.raises(
        RuntimeError, match=r"found out when a run starts, and .*batch_size.json is not there"
    ):
        _ = data.batches
    with pytest.raises(RuntimeError, match=r"needs trainer.predict"):
        data.prepare_data()
    for damaged in ("{}", "[", '{"batch_size": 0}', '{"batch_size": "3"}'):
        (tmp_path / "batch_size.json").write_text(damaged)
        with pytest.raises(ValueError, match=r"batch_size.json is damaged .* delete it"):
            _ = data.batches
    with pytest.raises(ValueError, match="order must be one of"):
        PoseDataModule(dataset, ground_truth_instances, objects, tmp_path, order="size")


def test_no_clock_waits_unless_stages_are_timed(root, store, tmp_path, monkeypatch):
    """On a machine with a GPU the only waits are those for results."""
    waits = []
    monkeypatch.setattr(foundpose.utils.timing.torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(foundpose.utils.timing.torch.cuda, "synchronize", lambda *_: waits.append(1))
    dataset = BopDataset(root)
    objects = DatasetObjects(dataset, store)
    for time_stages in (True, False):
        folder = tmp_path / str(time_stages)
        settings = {"pictures": TrueCoordinates(), "batch_size": 3, "max_images": 1}
        data = PoseDataModule(dataset, ground_truth_instances, objects, folder, **settings)
        module = PoseEvaluation(make_pipeline(), objects, folder, time_stages)
        waits.clear()
        module_trainer = trainer()
        estimate_dataset(module_trainer, module, data)
        assert bool(waits) == time_stages
        record = json.loads((folder / "shards" / "rank-00000.jsonl").read_text().splitlines()[0])
        assert ("pnp" in record["seconds"]) == time_stages
        assert record["seconds"]["pipeline"] == pytest.approx(sum(r["seconds"] for r in record["records"]))
        assert record["seconds"]["pipeline"] > 0


@pytest.mark.gpu
def test_auto_on_a_gpu(root, store, tmp_path):
    dataset = BopDataset(root)
    objects = DatasetObjects(dataset, store)
    data = PoseDataModule(dataset, ground_truth_instances, objects, tmp_path, TrueCoordinates(), "auto")
    estimate_dataset(trainer(accelerator="gpu"), PoseEvaluation(make_pipeline(), objects, tmp_path), data)
    assert json.loads((tmp_path / "batch_size.json").read_text())["batch_size"] == 4
