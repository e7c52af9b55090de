import pickle

import pytest
import torch
import torch.nn.functional as F
from safetensors.torch import save_file

from foundpose.features.weights import WeightsNotFoundError
from foundpose.refinement.megapose import MegaPoseNetwork
from foundpose.refinement.pose_update import IDENTITY_UPDATE

RUNS = {"pose": "refiner-rgb-653307694", "score": "coarse-rgb-906902141"}
VIEWS = {"pose": 4, "score": 1}


def published_state(head, width=64, seed=0):
    """Random weights under the published names: conv1, bn1, layer1.0.conv1, … fc, and the head."""
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.randn(shape, generator=generator) * (2.0 / max(1, torch.Size(shape[1:]).numel())) ** 0.5

    state = {}

    def norm(name, channels):
        state[f"backbone.{name}.weight"] = 1.0 + 0.1 * draw(channels)
        state[f"backbone.{name}.bias"] = 0.1 * draw(channels)
        state[f"backbone.{name}.running_mean"] = 0.1 * draw(channels)
        state[f"backbone.{name}.running_var"] = 1.0 + 0.5 * torch.rand(channels, generator=generator)
        state[f"backbone.{name}.num_batches_tracked"] = torch.tensor(7)

    state["backbone.conv1.weight"] = draw(width, 3 + 6 * VIEWS[head], 7, 7)
    norm("bn1", width)
    before = width
    for layer, count in enumerate((3, 4, 6, 3), start=1):
        channels = width * 2 ** (layer - 1)
        for block in range(count):
            name = f"layer{layer}.{block}"
            state[f"backbone.{name}.conv1.weight"] = draw(channels, before, 3, 3)
            norm(f"{name}.bn1", channels)
            state[f"backbone.{name}.conv2.weight"] = draw(channels, channels, 3, 3)
            norm(f"{name}.bn2", channels)
            if before != channels:
                state[f"backbone.{name}.downsample.0.weight"] = draw(channels, before, 1, 1)
                norm(f"{name}.downsample.1", channels)
            before = channels
    state["backbone.fc.weight"], state["backbone.fc.bias"] = draw(before, before), draw(before)
    name, outputs = ("pose_fc", 9) if head == "pose" else ("views_logits_head", 1)
    state[f"{name}.weight"], state[f"{name}.bias"] = draw(outputs, before), draw(outputs)
    return state


def older(state):
    """The same under the names of older checkpoints."""
    names = {"backbone.": "backbone.backbone.", "views_logits_head.": "backbone.head.0."}
    renamed = {}
    for key, value in state.items():
        start = next((s for s in names if key.startswith(s)), "")
        renamed[names.get(start, "") + key.removeprefix(start)] = value
    return renamed


def plain_forward(state, x):
    """ResNet-34 and its head, written out over the published names."""

    def norm(x, name):
        mean, variance, weight, bias = (
            state[f"backbone.{name}.{part}"][None, :, None, None]
            for part in ("running_mean", "running_var", "weight", "bias")
        )
        return (x - mean) / torch.sqrt(variance + 1e-5) * weight + bias

    def conv(x, name, stride, padding):
        return F.conv2d(x, state[f"backbone.{name}.weight"], stride=stride, padding=padding)

    x = norm(conv(x, "conv1", 2, 3), "bn1").clamp(min=0)
    x = F.max_pool2d(x, 3, 2, 1)
    for layer, count in enumerate((3, 4, 6, 3), start=1):
        for block in range(count):
            name, stride = f"layer{layer}.{block}", 2 if layer > 1 and block == 0 else 1
            y = norm(conv(x, f"{name}.conv1", stride, 1), f"{name}.bn1").clamp(min=0)
            y = norm(conv(y, f"{name}.conv2", 1, 1), f"{name}.bn2")
            if f"backbone.{name}.downsample.0.weight" in state:
                x = norm(conv(x, f"{name}.downsample.0", stride, 0), f"{name}.downsample.1")
            x = (x + y).clamp(min=0)
    x = x.flatten(2).mean(-1) @ state["backbone.fc.weight"].T + state["backbone.fc.bias"]
    head = "pose_fc" if "pose_fc.weight" in state else "views_logits_head"
    return x @ state[f"{head}.weight"].T + state[f"{head}.bias"]


@pytest.mark.parametrize("head", ["pose", "score"])
@pytest.mark.parametrize("names", ["newer", "older"])
def test_published_layout_against_a_plain_forward(head, names, tmp_path):
    state = published_state(head)
    file = tmp_path / "checkpoint.pth.tar"
    torch.save({"epoch": 700, "state_dict": state if names == "newer" else older(state)}, file)
    network = MegaPoseNetwork(head, VIEWS[head], weights=file).eval()
    pictures = torch.rand(2, 3 + 6 * VIEWS[head], 240, 320, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        ours, plain = network(pictures), plain_forward(state, pictures)
    if head == "pose":  # ours are the shift and the depth first, theirs the rotation
        plain = torch.cat([plain[:, 6:], plain[:, :6]], dim=1)
    torch.testing.assert_close(ours, plain, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("head", ["pose", "score"])
def test_weights_are_found_where_they_may_lie(head, tmp_path):
    state = published_state(head, width=4)
    run = tmp_path / "megapose-models" / RUNS[head]
    run.mkdir(parents=True)
    torch.save({"state_dict": state}, run / "checkpoint.pth.tar")
    (run / "config.yaml").write_text("!!python/object:os.system {}")  # is not read
    hub = tmp_path / "hub"
    hub.mkdir()
    save_file(state, hub / "model.safetensors")
    own = tmp_path / "own.safetensors"
    MegaPoseNetwork(head, VIEWS[head], 4, run).save(own)
    for weights in (
        run,
        run / "checkpoint.pth.tar",
        run.parent,
        hub,
        hub / "model.safetensors",
        own,
        str(run),
    ):
        found = MegaPoseNetwork(head, VIEWS[head], 4, weights).state_dict()
        assert all(torch.equal(found[key], value) for key, value in state.items())


def test_missing_weights_say_how_to_get_them(tmp_path):
    for weights in (tmp_path, tmp_path / "absent", tmp_path / "absent.safetensors"):
        with pytest.raises(
            WeightsNotFoundError, match=r"(?s)absent|checkpoint.*rclone.*refiner-rgb-653307694"
        ):
            MegaPoseNetwork("pose", 4, weights=weights)
    with pytest.raises(WeightsNotFoundError, match="coarse-rgb-906902141"):
        MegaPoseNetwork("score", 1, weights=tmp_path)


def test_weights_of_another_network_are_refused(tmp_path):
    torch.save({"state_dict": published_state("score", width=4)}, tmp_path / "coarse.tar")
    torch.save({"state_dict": published_state("pose", width=8)}, tmp_path / "wide.tar")
    (tmp_path / "evil.tar").write_bytes(pickle.dumps({"state_dict": print}))
    with pytest.raises(ValueError, match=r"do not fit: missing.*pose_fc"):
        MegaPoseNetwork("pose", 4, 4, tmp_path / "coarse.tar")
    with pytest.raises(ValueError, match="of the wrong shape"):
        MegaPoseNetwork("pose", 4, 4, tmp_path / "wide.tar")
    with pytest.raises(ValueError, match="not a checkpoint"):
        MegaPoseNetwork("pose", 4, 4, tmp_path / "evil.tar")


def test_untrained_moves_nothing_and_depends_on_its_seed_alone():
    pictures = torch.rand(2, 27, 64, 64)
    networks = [MegaPoseNetwork("pose", 4, 4, seed=seed) for seed in (3, 3, 4)]
    assert torch.equal(networks[0](pictures), torch.tensor(IDENTITY_UPDATE).expand(2, 9))
    weights = [network.backbone.conv1.weight for network in networks]
    assert torch.equal(weights[0], weights[1])
    assert not torch.equal(weights[0], weights[2])


def test_bad_settings_and_input():
    with pytest.raises(ValueError, match="head must be"):
        MegaPoseNetwork("depth", 4, seed=0)
    with pytest.raises(ValueError, match="goes with a seed"):
        MegaPoseNetwork("pose", 4)
    with pytest.raises(ValueError, match=r"\(M, 27, H, W\), got \(1, 9, 8, 8\)"):
        MegaPoseNetwork("pose", 4, 4, seed=0)(torch.zeros(1, 9, 8, 8))


def test_gradients_reach_all_parameters():
    network = MegaPoseNetwork("score", 1, 4, seed=0)
    network(torch.rand(2, 9, 64, 64)).sum().backward()
    assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in network.parameters())
