import torch

from foundpose.representation import ObjectGroups, TemplatePatches


def test_what_objects_say_is_joined_in_the_order_of_the_batch_and_padded():
    groups = ObjectGroups(["a", "b", "c"], torch.tensor([1, 0, 1]), 3, torch.device("cpu"))
    lengths = {"a": 2, "b": 3}

    def patches(obj, rows):
        size, value = lengths[obj], rows.float()[:, None]
        valid = torch.ones(len(rows), size, dtype=torch.bool)
        return TemplatePatches(value.expand(-1, size), value.expand(-1, size), None, valid)

    found = groups.map(patches)
    assert found.descriptors.tolist() == [[0.0, 0.0, 0.0], [1.0, 1.0, 0.0], [2.0, 2.0, 2.0]]
    assert found.valid.tolist() == [[True, True, True], [True, True, False], [True, True, True]]
    assert found.pixels is None
    assert groups.map(lambda obj, rows: rows).tolist() == [0, 1, 2]
