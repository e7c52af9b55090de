import random
import shutil

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from foundpose.bop import BopDataset, Instance, detected_instances, ground_truth_instances
from foundpose.bop.pictures import Photographs
from foundpose.evaluation.data import BatchesOfRank, InstanceBatches, plan_batches
from foundpose.evaluation.records import instance_record
from foundpose.evaluation.shards import BatchRecord, ShardWriter, read_shards, shard_path


def instances(count, seed=0):
    draw = random.Random(seed)
    return [
        Instance(draw.randrange(3), draw.randrange(5), draw.randrange(4), draw.random(), 0.1)
        for _ in range(count)
    ]


@settings(deadline=None)
@given(st.integers(1, 60), st.integers(1, 9), st.sampled_from(["image", "object"]), st.integers(0, 1000))
def test_plan_holds_every_instance_once(count, batch_size, order, seed):
    todo = instances(count, seed)
    batches = plan_batches(todo, batch_size, order)
    assert sorted(map(id, todo)) == sorted(id(i) for batch in batches for i in batch)
    assert all(len(batch) == batch_size for batch in batches[:-1])
    assert 1 <= len(batches[-1]) <= batch_size
    key = [(i.obj_id if order == "object" else 0, i.scene_id, i.im_id) for batch in batches for i in batch]
    assert key == sorted(key)


def test_plan_refuses_what_makes_no_sense():
    with pytest.raises(ValueError, match="batch_size must be at least 1, got 0"):
        plan_batches(instances(3), 0)
    with pytest.raises(ValueError, match=r"order must be one of .*, got 'time'"):
        plan_batches(instances(3), 1, "time")


@settings(deadline=None)
@given(st.sets(st.integers(0, 50)), st.integers(1, 7))
def test_processes_share_the_batches(batches, world):
    shares = [list(BatchesOfRank(sorted(batches), world, rank)) for rank in range(world)]
    assert sorted(i for share in shares for i in share) == sorted(batches)
    assert max(map(len, shares)) - min(map(len, shares)) <= 1
    assert [len(BatchesOfRank(sorted(batches), world, rank)) for rank in range(world)] == list(
        map(len, shares)
    )


def test_batches_read_each_image_once(tiny_bop):
    dataset = BopDataset(tiny_bop)
    read = []

    def pictures(dataset, scene_id, im_id):
        read.append(im_id)
        return dataset.image(scene_id, im_id)

    found = detected_instances(dataset, tiny_bop / "detections" / "cnos-fastsam", masks_per_instance=2)
    batches = InstanceBatches(dataset, pictures, plan_batches(found, 3))
    first, second = batches[0], batches[1]
    assert read == [0, 1, 2]  # image 1 is in both batches
    assert (first.image_index, second.image_index) == ((0, 0, 1), (0, 1, 1))
    assert [i.im_id for i in second.instances] == [1, 2, 2]
    for batch in (first, second):
        for mask, i, instance in zip(batch.masks, batch.image_index, batch.instances, strict=True):
            assert torch.equal(batch.images[i], dataset.image(1, instance.im_id))
            assert torch.equal(mask, instance.mask(dataset))
            assert torch.equal(batch.K[i], dataset.intrinsics(1, instance.im_id).float())


def test_a_mask_of_another_size_is_refused(tiny_bop, tmp_path):
    root = shutil.copytree(tiny_bop, tmp_path / "tiny")
    Image.new("L", (320, 240), 255).save(root / "test" / "000001" / "mask_visib" / "000000_000000.png")
    dataset = BopDataset(root)
    batches = InstanceBatches(dataset, Photographs(), plan_batches(ground_truth_instances(dataset), 1))
    with pytest.raises(ValueError, match="320x240 px, its image 640x480 px"):
        batches[0]


def record(index, batches):
    return BatchRecord(index, [instance_record(i) | {"valid": True} for i in batches[index]], {"pnp": 0.5})


def test_shards_survive_a_kill_at_any_byte(tmp_path):
    batches = plan_batches(instances(8), 2)
    writer = ShardWriter(tmp_path, 0)
    for index in (0, 2):
        writer.append(record(index, batches))
    path = shard_path(tmp_path, 0)
    whole = path.read_bytes()
    first = whole.index(b"\n") + 1
    for end in (0, 1, first - 1, first, first + 10, len(whole) - 1, len(whole)):
        path.write_bytes(whole[:end])
        expected = [i for i, length in ((0, first), (2, len(whole))) if end >= length]
        assert list(read_shards(tmp_path, batches)) == expected
        # What was cut off does not spoil what is written next.
        ShardWriter(tmp_path, 0).append(record(3, batches))
        found = read_shards(tmp_path, batches)
        assert list(found) == [*expected, 3]
        assert found[3] == record(3, batches)


def test_shards_of_several_processes(tmp_path):
    batches = plan_batches(instances(8), 2)
    for rank, indices in enumerate([(2, 0), (1, 2)]):
        writer = ShardWriter(tmp_path, rank)
        for index in indices:
            writer.append(record(index, batches))
    assert list(read_shards(tmp_path, batches)) == [0, 1, 2]
    assert read_shards(tmp_path / "empty", batches) == {}


def test_shards_of_another_plan_are_refused(tmp_path):
    batches = plan_batches(instances(8), 2)
    ShardWriter(tmp_path, 0).append(record(1, batches))
    for other in (plan_batches(instances(8, seed=1), 2), batches[:1], plan_batches(instances(8), 3)):
        with pytest.raises(ValueError, match=r"batch 1 in .* has other instances"):
            read_shards(tmp_path, other)
    path = shard_path(tmp_path, 0)
    path.write_bytes(b'{"number": 0}\n' + path.read_bytes())
    with pytest.raises(ValueError, match="line 1 is damaged"):
        read_shards(tmp_path, batches)
