"""Many objects at once: lazily loaded, mapped into memory, bounded."""

import ctypes
import gc
import json
import os
import shutil
import sys
from pathlib import Path

import pytest
import torch

import foundpose.evaluation.objects
from foundpose.bop import BopDataset
from foundpose.evaluation.objects import DatasetObjects
from foundpose.features import CoordinateCode, PcaProjection
from foundpose.geometry import SuperFibonacci
from foundpose.onboarding import Onboarder, RepresentationStore
from foundpose.rendering import CoordinateRenderer
from foundpose.representation import ObjectRepresentation
from foundpose.retrieval import SoftAssignBow, VisualWords

MIB = 2**20
linux_only = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")


def make_store(folder: Path, mmap: bool = True, **settings) -> RepresentationStore:
    onboarder = Onboarder(
        CoordinateRenderer(),
        CoordinateCode(channels=32),
        SuperFibonacci(8),
        VisualWords(20),
        SoftAssignBow(),
        projection=PcaProjection(16),
        image_size=224,
        **settings,
    )
    return RepresentationStore(folder, onboarder, mmap=mmap)


@pytest.fixture(scope="module")
def root(tiny_bop, tmp_path_factory) -> Path:
    return shutil.copytree(tiny_bop, tmp_path_factory.mktemp("objects") / "tiny")


@pytest.fixture
def loads(monkeypatch) -> list[str]:
    """Names of the mesh files that were loaded."""
    names: list[str] = []
    original = foundpose.evaluation.objects.load_mesh

    def load(path: Path, color=None):
        names.append(Path(path).name)
        return original(path, color)

    monkeypatch.setattr(foundpose.evaluation.objects, "load_mesh", load)
    return names


def resident() -> float:
    """MiB of this process that are in memory."""
    # What earlier tests have freed would be used again, or given back in the middle of a measurement.
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) / 1024
    raise AssertionError("no VmRSS")


def large_representation(small: ObjectRepresentation, patches: int = 40_000) -> ObjectRepresentation:
    """A representation of about 44 MiB: 100 templates of 400 patches, 256-d."""
    d, words, templates = 256, 200, 100
    g = torch.Generator().manual_seed(0)
    projection = PcaProjection.from_covariance(torch.zeros(d), torch.eye(d), d)
    return ObjectRepresentation(
        projection=projection,
        words=torch.randn(words, d, generator=g),
        idf=torch.ones(words),
        template_bow=torch.rand(templates, words, generator=g),
        descriptors=torch.randn(patches, d, generator=g),
        points_model=torch.randn(patches, 3, generator=g),
        patch_index=torch.zeros(patches, dtype=torch.int16),
        template_offsets=torch.arange(templates + 1) * (patches // templates),
        T_template_from_model=torch.eye(4).repeat(templates, 1, 1),
        K_template=torch.eye(3).repeat(templates, 1, 1),
        template_cls=None,
        info=small.info,
    )


@linux_only
def test_open_objects_take_no_memory_until_they_are_used(oracle_blob, tmp_path) -> None:
    first = tmp_path / "0.safetensors"
    large_representation(oracle_blob).save(first)
    size = first.stat().st_size / MIB
    assert size > 39
    paths = [first] + [Path(shutil.copy(first, tmp_path / f"{i}.safetensors")) for i in range(1, 20)]
    ObjectRepresentation.load(first)  # whatever is loaded once
    before = resident()
    opened = [ObjectRepresentation.load(path) for path in paths]
    after = resident()
    # 800 MiB of files.
    assert after - before < 0.03 * size * len(paths)
    descriptors = [r.gather_templates(torch.tensor([17, 60])).descriptors for r in opened]
    used = resident()
    # Each has two of 100 templates in use, 0.8 MiB, and what the system reads around them.
    assert used - after < 0.15 * size * len(paths)
    for descriptor in descriptors:
        assert torch.equal(descriptor, descriptors[0])
    assert len(os.listdir("/proc/self/fd")) < 15 + len(paths)  # mapped files need not be open
    # Whole, for comparison.
    del descriptors
    whole = [ObjectRepresentation.load(path, mmap=False) for path in paths[:5]]
    assert resident() - used > 4.5 * size
    assert torch.equal(whole[4].descriptors, opened[4].descriptors)


def test_a_representation_outlives_its_file(oracle_blob, tmp_path) -> None:
    path = tmp_path / "blob.safetensors"
    oracle_blob.save(path)
    opened = ObjectRepresentation.load(path)
    changed = oracle_blob.with_storage("float16")
    changed.save(path)  # replaces the file
    index = torch.arange(100)
    expected = oracle_blob.gather_templates(index).descriptors
    assert torch.equal(opened.gather_templates(index).descriptors, expected)
    assert ObjectRepresentation.load(path).descriptors.dtype == torch.float16
    again = ObjectRepresentation.load(path)
    path.unlink()
    assert torch.equal(
        again.gather_templates(index).points_model, oracle_blob.gather_templates(index).points_model
    )


def test_writing_into_a_buffer_leaves_the_file_alone(oracle_blob, tmp_path) -> None:
    path = tmp_path / "blob.safetensors"
    oracle_blob.save(path)
    content = path.read_bytes()
    opened, other = ObjectRepresentation.load(path), ObjectRepresentation.load(path)
    opened.descriptors.zero_()
    opened.idf.add_(1.0)
    assert path.read_bytes() == content
    assert torch.equal(other.descriptors, oracle_blob.descriptors)
    # And gradients work on a mapped buffer.
    other.descriptors.requires_grad_()
    other.gather_templates(torch.tensor([3])).descriptors.sum().backward()
    assert other.descriptors.grad.sum() == other.template_offsets.diff()[3] * 64


def test_meshes_are_loaded_once_and_not_at_all_the_next_time(root, tmp_path, loads) -> None:
    dataset = BopDataset(root)
    objects = DatasetObjects(dataset, make_store(tmp_path))
    objects.onboard([1, 2])
    assert loads == ["obj_000001.ply", "obj_000002.ply"]
    first = objects.representations([1, 2])
    assert len(loads) == 2
    # Another process, say: representations are found without any mesh.
    again = DatasetObjects(dataset, make_store(tmp_path))
    again.onboard([1, 2])
    found = again.representations([2, 1])
    assert [again.path(i) for i in (1, 2)] == [objects.path(i) for i in (1, 2)]
    assert len(loads) == 2
    assert torch.equal(found[1].descriptors, first[0].descriptors)
    # The file is the one that the mesh's own checksum leads to.
    assert again.path(1) == again.store.path(again.mesh(1), dataset.object_name(1))
    records = list(tmp_path.glob(".tiny-meshes-*.json"))
    assert len(records) == 1
    assert json.loads(records[0].read_text()) == {str(i): objects.mesh(i).checksum for i in (1, 2)}


def test_a_changed_mesh_or_texture_is_noticed(root, tmp_path, loads) -> None:
    copy = shutil.copytree(root, tmp_path / "tiny")
    store = make_store(tmp_path / "store")

    def look() -> tuple[Path, list[str]]:
        """The first object's file, and the meshes that were loaded to tell it."""
        loads.clear()
        objects = DatasetObjects(BopDataset(copy), store)
        path = objects.path(1)
        objects.onboard([])  # keeps what is known
        return path, list(loads)

    old, loaded = look()
    assert loaded == ["obj_000001.ply"]
    assert look() == (old, [])
    # The objects change places.
    a, b, info = (copy / "models" / name for name in ("obj_000001.ply", "obj_000002.ply", "models_info.json"))
    a.rename(copy / "x")
    b.rename(a)
    (copy / "x").rename(b)
    facts = json.loads(info.read_text())
    info.write_text(json.dumps({"1": facts["2"], "2": facts["1"]}))
    new, loaded = look()
    assert new != old
    assert loaded == ["obj_000001.ply"]
    # Any other file may be a texture.
    (copy / "models" / "colours").mkdir()
    (copy / "models" / "colours" / "obj_000001.png").write_bytes(b"not looked into")
    assert look() == (new, ["obj_000001.ply"])
    assert look() == (new, [])


def test_meshes_are_dropped_beyond_their_limit(root, tmp_path, loads) -> None:
    dataset = BopDataset(root)
    store = make_store(tmp_path)
    everything = DatasetObjects(dataset, store)
    sizes = [foundpose.evaluation.objects._mesh_size(everything.mesh(i)) for i in (1, 2)]
    mesh = everything.mesh(1)
    parts = (mesh.vertices, mesh.faces, mesh.vertex_normals, mesh.vertex_colors, mesh.uv, mesh.texture)
    assert sizes[0] * MIB == sum(p.numel() * p.element_size() for p in parts if p is not None)
    assert everything.mesh(1) is mesh
    loads.clear()
    limited = DatasetObjects(dataset, store, mesh_limit=max(sizes) * 1.1)
    first = limited.mesh(1)
    assert limited.mesh(1) is first
    limited.mesh(2)
    assert limited.mesh(1) is not first
    assert loads == ["obj_000001.ply", "obj_000002.ply", "obj_000001.ply"]
    # One that is larger than the limit is kept until the next is asked for.
    tiny = DatasetObjects(dataset, store, mesh_limit=1e-3)
    assert tiny.mesh(2) is tiny.mesh(2)
    assert DatasetObjects(dataset, store, mesh_limit=None).mesh(1).checksum == mesh.checksum
    with pytest.raises(ValueError, match="mesh_limit must be positive"):
        DatasetObjects(dataset, store, mesh_limit=0)


@pytest.mark.parametrize("storage", ["float32", "pq"])
def test_a_broken_or_missing_file_is_made_again(root, tmp_path, storage) -> None:
    dataset = BopDataset(root)
    objects = DatasetObjects(dataset, make_store(tmp_path, storage=storage, pq_subspaces=4))
    objects.onboard([1])
    path = objects.path(1)
    expected = ObjectRepresentation.load(path, mmap=False)
    path.write_bytes(path.read_bytes()[:1000])
    for _ in range(2):
        again = DatasetObjects(dataset, make_store(tmp_path, storage=storage, pq_subspaces=4))
        (found,) = again.representations([1])
        assert found.info == expected.info
        assert torch.equal(found.descriptors, expected.descriptors)
        path.unlink()


def test_the_store_maps_files_unless_told_otherwise(root, tmp_path) -> None:
    dataset = BopDataset(root)
    DatasetObjects(dataset, make_store(tmp_path)).onboard([1])
    for mmap in (True, False):
        objects = DatasetObjects(dataset, make_store(tmp_path, mmap=mmap))
        (representation,) = objects.representations([1])
        if sys.platform.startswith("linux"):
            mapped = objects.path(1).name in Path("/proc/self/maps").read_text()
            assert mapped == mmap
        assert objects.representations([1])[0] is representation
        del representation, objects


@pytest.mark.gpu
@pytest.mark.parametrize("storage", ["float32", "int8", "pq"])
def test_on_a_gpu_representations_are_copies(root, tmp_path, storage) -> None:
    objects = DatasetObjects(BopDataset(root), make_store(tmp_path, storage=storage, pq_subspaces=4))
    objects.onboard([1])
    reference = ObjectRepresentation.load(objects.path(1))
    (moved,) = objects.representations([1], "cuda")
    direct = ObjectRepresentation.load(objects.path(1), device="cuda")
    index = torch.tensor([0, 5])
    for each in (moved, direct):
        assert all(buffer.is_cuda for buffer in each.buffers())
        descriptors = each.gather_templates(index.cuda()).descriptors.cpu()
        torch.testing.assert_close(descriptors, reference.gather_templates(index).descriptors)
