"""Tokens of any layer of any module."""

import difflib
import threading
from collections.abc import Mapping

from torch import Tensor, nn


class _ForwardStopped(Exception):  # noqa: N818 (a signal, not an error)
    """Unwinds a forward pass once the hooked layer has run; never leaves ``FeatureHook.forward``."""


class FeatureHook(nn.Module):
    """Returns what one submodule of a module puts out, and runs nothing that lies behind it.

    The module is called as usual; when the layer has run, the rest of the forward pass is skipped. The hook is
    registered for the duration of a call only, so the module stays usable on its own, and several
    ``FeatureHook``s, also in several threads, may share one module.

    Args:
        module: any module, e.g. a vision transformer.
        layer: dotted name of the submodule as in ``module.named_modules()``, e.g. ``"encoder.layer.9"``,
            or the submodule itself.
        stop: skip what lies behind the layer. ``False`` runs the whole module, e.g. for its side effects.

    Raises:
        ValueError: ``layer`` is no submodule of ``module``.

    Differentiable w.r.t. the inputs and the parameters up to the layer; parameters that are frozen stay so, and
    the graph is the module's own.
    """

    def __init__(self, module: nn.Module, layer: str | nn.Module, stop: bool = True) -> None:
        super().__init__()
        self.module = module
        self.layer = _layer_name(module, layer)
        self.stop = stop

    def forward(self, *args: object, **kwargs: object) -> Tensor:
        """Call the module with these arguments.

        Returns:
            The output of the layer's first call. Where the layer returns a tuple, list or mapping (as the layers
            of transformers may), the first tensor in it.

        Raises:
            RuntimeError: the forward pass did not run the layer, or the layer put out no tensor.
        """
        outputs: list[object] = []
        # An exception of its own per call: a nested FeatureHook must not swallow the signal of an outer one.
        signal = _ForwardStopped()
        thread = threading.get_ident()

        def capture(_module: nn.Module, _inputs: object, output: object) -> None:
            if threading.get_ident() != thread or outputs:
                return
            outputs.append(output)
            if self.stop:
                raise signal

        handle = self.module.get_submodule(self.layer).register_forward_hook(capture)
        try:
            self.module(*args, **kwargs)
        except _ForwardStopped as stopped:
            if stopped is not signal:
                raise
        finally:
            handle.remove()
        if not outputs:
            raise RuntimeError(
                f"layer {self.layer!r} was not run by the forward pass of {type(self.module).__name__}"
            )
        return _first_tensor(outputs[0], self.layer)

    def extra_repr(self) -> str:
        """Shown by ``print``."""
        return f"layer={self.layer!r}, stop={self.stop}"


def _layer_name(module: nn.Module, layer: str | nn.Module) -> str:
    names = {name: child for name, child in module.named_modules() if name}
    if isinstance(layer, nn.Module):
        for name, child in names.items():
            if child is layer:
                return name
        raise ValueError(
            f"layer, a {type(layer).__name__}, is not a submodule of this {type(module).__name__}"
        )
    if layer in names:
        return layer
    close = difflib.get_close_matches(layer, names, n=5, cutoff=0.5)
    hint = f"close matches: {', '.join(close)}" if close else f"its submodules begin with {list(names)[:5]}"
    raise ValueError(f"{type(module).__name__} has no submodule {layer!r}; {hint}")


def _first_tensor(output: object, layer: str) -> Tensor:
    if isinstance(output, Tensor):
        return output
    values: list[object] = []
    if isinstance(output, Mapping):
        values = list(output.values())
    elif isinstance(output, tuple | list):
        values = list(output)
    for value in values:
        if isinstance(value, Tensor):
            return value
    raise RuntimeError(f"layer {layer!r} put out no tensor but {type(output).__name__}")
