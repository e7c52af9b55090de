import copy

import pytest
import torch
from safetensors.torch import save_file

from foundpose.features import CoordinateCode
from foundpose.representation import ObjectRepresentation


def test_save_and_load_keep_everything(oracle_blob, tmp_path):
    path = tmp_path / "folder" / "blob.safetensors"
    oracle_blob.save(path)
    again = ObjectRepresentation.load(path, extractor=CoordinateCode())
    assert again.info == oracle_blob.info
    before, after = oracle_blob.state_dict(), again.state_dict()
    assert before.keys() == after.keys()
    for name, tensor in before.items():
        assert torch.equal(tensor, after[name]), name
        assert tensor.dtype == after[name].dtype
    assert again.max_patches == oracle_blob.max_patches
    assert [file.name for file in path.parent.iterdir()] == ["blob.safetensors"]


def test_another_extractor_is_refused(oracle_blob, tmp_path):
    path = tmp_path / "blob.safetensors"
    oracle_blob.save(path)
    with pytest.raises(ValueError, match=r"another extractor \(wavelength: 1\.0 here, 2\.0 given\)"):
        ObjectRepresentation.load(path, extractor=CoordinateCode(wavelength=2.0))


def test_bad_files(oracle_blob, tmp_path, monkeypatch):
    with pytest.raises(FileNotFoundError, match="onboard the object first"):
        ObjectRepresentation.load(tmp_path / "none.safetensors")
    path = tmp_path / "blob.safetensors"
    save_file({"x": torch.zeros(1)}, path)
    with pytest.raises(ValueError, match="holds no object representation"):
        ObjectRepresentation.load(path)
    oracle_blob.save(path)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(ValueError, match="not a readable safetensors file"):
        ObjectRepresentation.load(path)
    path.write_bytes(content)
    monkeypatch.setattr("foundpose.representation.object_representation.SCHEMA_VERSION", 99)
    with pytest.raises(ValueError, match="schema version 1, this library reads 99"):
        ObjectRepresentation.load(path)


def test_gathered_templates_are_the_slices(oracle_blob):
    r = oracle_blob
    index = torch.tensor([[3, 0], [99, 3]])
    patches = r.gather_templates(index)
    assert patches.descriptors.shape == (2, 2, r.max_patches, 64)
    for i in range(2):
        for j in range(2):
            t = int(index[i, j])
            rows = slice(int(r.template_offsets[t]), int(r.template_offsets[t + 1]))
            count = rows.stop - rows.start
            assert patches.valid[i, j].sum() == count
            assert patches.valid[i, j, :count].all()
            assert torch.equal(patches.descriptors[i, j, :count], r.descriptors[rows])
            assert torch.equal(patches.points_model[i, j, :count], r.points_model[rows])
            assert (patches.descriptors[i, j, count:] == 0).all()
            cells = r.patch_index[rows].long()
            expected = torch.stack([cells % 30, cells // 30], -1) * 14.0 + 6.5
            assert torch.equal(patches.pixels[i, j, :count], expected)


def test_gathering_is_differentiable(oracle_blob):
    r = copy.deepcopy(oracle_blob)
    r.descriptors.requires_grad_()
    r.gather_templates(torch.tensor([5])).descriptors.square().sum().backward()
    rows = slice(int(r.template_offsets[5]), int(r.template_offsets[6]))
    assert torch.allclose(r.descriptors.grad[rows], 2 * r.descriptors.detach()[rows])
    r.descriptors.grad[rows] = 0.0
    assert (r.descriptors.grad == 0).all()


def test_memory_is_counted_by_part(oracle_blob):
    memory = oracle_blob.memory_bytes()
    assert memory["descriptors"] == len(oracle_blob.descriptors) * 64 * 4
    assert memory["template_bow"] == 100 * 200 * 4
    assert memory["total"] == sum(value for name, value in memory.items() if name != "total")
    half = copy.deepcopy(oracle_blob).half()
    assert half.descriptors.dtype == torch.float16
    assert half.memory_bytes()["descriptors"] == memory["descriptors"] // 2
    assert half.template_offsets.dtype == torch.int64
