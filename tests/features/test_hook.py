import threading

import pytest
import torch
from torch import Tensor, nn

from foundpose.features.hook import FeatureHook


class Counted(nn.Module):
    """A linear layer that counts its calls; returns what ``wrap`` makes of its output."""

    def __init__(self, wrap=lambda x: x) -> None:
        super().__init__()
        self.linear = nn.Linear(4, 4)
        self.wrap = wrap
        self.calls = 0

    def forward(self, x: Tensor):
        self.calls += 1
        return self.wrap(self.linear(x))


class Stack(nn.Module):
    def __init__(self, depth: int = 4) -> None:
        super().__init__()
        self.layers = nn.ModuleList(Counted() for _ in range(depth))
        self.head = nn.Linear(4, 2)
        self.unused = nn.Linear(4, 4)

    def forward(self, x: Tensor, scale: float = 1.0) -> Tensor:
        for layer in self.layers:
            x = torch.tanh(layer(x * scale))
        return self.head(x)


class Net(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.encoder = Stack()

    def forward(self, x: Tensor, scale: float = 1.0) -> Tensor:
        return self.encoder(x, scale=scale)


@pytest.fixture
def net() -> Net:
    torch.manual_seed(0)
    return Net()


def expected_output(net: Net, x: Tensor, layer: int, scale: float = 1.0) -> Tensor:
    for k in range(layer):
        x = torch.tanh(net.encoder.layers[k].linear(x * scale))
    return net.encoder.layers[layer].linear(x * scale)


@pytest.mark.parametrize("layer", range(4))
def test_returns_the_layers_output_and_runs_nothing_behind_it(net: Net, layer: int) -> None:
    x = torch.randn(3, 4)
    y = FeatureHook(net, f"encoder.layers.{layer}")(x, scale=0.5)
    torch.testing.assert_close(y, expected_output(net, x, layer, scale=0.5))
    assert [child.calls for child in net.encoder.layers] == [1] * (layer + 1) + [0] * (3 - layer)


def test_without_stop_runs_everything(net: Net) -> None:
    x = torch.randn(3, 4)
    y = FeatureHook(net, "encoder.layers.1", stop=False)(x)
    torch.testing.assert_close(y, expected_output(net, x, 1))
    assert [child.calls for child in net.encoder.layers] == [1] * 4


def test_layer_may_be_a_submodule(net: Net) -> None:
    x = torch.randn(3, 4)
    hook = FeatureHook(net, net.encoder.layers[2])
    assert hook.layer == "encoder.layers.2"
    torch.testing.assert_close(hook(x), expected_output(net, x, 2))
    with pytest.raises(ValueError, match="not a submodule"):
        FeatureHook(net, nn.Linear(4, 4))


def test_module_is_untouched_after_use_and_after_errors(net: Net) -> None:
    x = torch.randn(3, 4)
    before = net(x)
    hook = FeatureHook(net, "encoder.layers.1")
    hook(x)
    with pytest.raises(RuntimeError):
        hook(torch.randn(3, 5))
    assert all(not module._forward_hooks for module in net.modules())
    assert torch.equal(net(x), before)


def test_gradients_reach_input_and_parameters_up_to_the_layer(net: Net) -> None:
    x = torch.randn(3, 4, requires_grad=True)
    FeatureHook(net, "encoder.layers.2")(x).square().sum().backward()
    assert x.grad is not None
    assert x.grad.abs().sum() > 0
    weights = [child.linear.weight.grad for child in net.encoder.layers]
    assert all(w is not None and w.abs().sum() > 0 for w in weights[:3])
    assert weights[3] is None


@pytest.mark.parametrize(
    "wrap",
    [lambda y: (y, None), lambda y: ("label", y), lambda y: [y, -y], lambda y: {"hidden": y, "other": -y}],
)
def test_layers_that_return_containers(wrap) -> None:
    net = nn.Sequential(Counted(wrap))
    x = torch.randn(2, 4)
    torch.testing.assert_close(FeatureHook(net, "0")(x), net[0].linear(x))


def test_layer_without_tensor_output() -> None:
    with pytest.raises(RuntimeError, match="no tensor"):
        FeatureHook(nn.Sequential(Counted(lambda y: "text")), "0")(torch.zeros(1, 4))


def test_unknown_layer_lists_close_names(net: Net) -> None:
    with pytest.raises(ValueError, match=r"no submodule 'encoder\.layer\.1'.*encoder\.layers\.1"):
        FeatureHook(net, "encoder.layer.1")
    with pytest.raises(ValueError, match="encoder"):
        FeatureHook(net, "xyzzy")


def test_layer_that_forward_does_not_run(net: Net) -> None:
    with pytest.raises(RuntimeError, match="was not run"):
        FeatureHook(net, "encoder.unused")(torch.zeros(1, 4))


def test_nested_hooks_do_not_swallow_each_others_signal(net: Net) -> None:
    x = torch.randn(3, 4)
    inner = FeatureHook(net, "encoder.layers.3")
    outer = FeatureHook(inner, "module.encoder.layers.1")
    torch.testing.assert_close(outer(x), expected_output(net, x, 1))
    # the other way about the inner hook stops first, so the outer one's layer is not reached
    blocked = FeatureHook(FeatureHook(net, "encoder.layers.1"), "module.encoder.layers.3")
    with pytest.raises(RuntimeError, match="was not run"):
        blocked(x)
    assert all(not module._forward_hooks for module in net.modules())


def test_module_called_several_times_gives_its_first_output() -> None:
    layer = Counted()
    net = nn.Sequential(layer, layer)
    x = torch.randn(2, 4)
    torch.testing.assert_close(FeatureHook(net, "0", stop=False)(x), layer.linear(x))


def test_threads_share_one_module(net: Net) -> None:
    inputs = torch.randn(4, 40, 3, 4)
    hooks = [FeatureHook(net, f"encoder.layers.{k}") for k in range(4)]
    failures: list[str] = []
    barrier = threading.Barrier(4)

    def work(k: int) -> None:
        barrier.wait()
        for x in inputs[k]:
            if not torch.allclose(hooks[k](x), expected_output(net, x, k)):
                failures.append(f"thread {k}")

    threads = [threading.Thread(target=work, args=(k,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failures
    assert all(not module._forward_hooks for module in net.modules())


def test_state_dict_round_trip(net: Net) -> None:
    hook = FeatureHook(net, "encoder.layers.1")
    torch.manual_seed(1)
    other = FeatureHook(Net(), "encoder.layers.1")
    other.load_state_dict(hook.state_dict())
    x = torch.randn(2, 4)
    assert torch.equal(hook(x), other(x))
