"""Checkpoints by name, from a local server with the protocol of the Hugging Face hub."""

import hashlib
import io
import json
import os
import re
import threading
import zipfile
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
from command_line import invoke

from data_contracts.checkpoint import Checkpoint
from flows.checkpoint_downloads import pull, read_catalog, resolve_address
from worldpose.detection.models import load_detectors, weights_of
from worldpose.detection.settings import DetectionSettings
from worldpose.errors import InputError, UsageError, WorldposeError

REVISION = "0123456789abcdef0123456789abcdef01234567"
NET = os.urandom(3 << 20)
CATALOG = read_catalog(None)
CONFIG = b'{"model_type": "rt_detr"}'


class Hub(BaseHTTPRequestHandler):
    """Large files redirect to a content server with ranges, small ones are answered directly."""

    protocol_version = "HTTP/1.1"

    def do_GET(self):
        hub = self.server
        hub.asked.append((self.command, self.path, self.headers.get("Range")))
        found = re.fullmatch(rf"/team/net/resolve/{REVISION}/(.+)", self.path)
        if found and found[1] in hub.large:
            content = hub.large[found[1]]
            self.send(302, b"", {"Location": hub.elsewhere or f"{hub.contents}/cdn/{found[1]}"})
        elif found and found[1] in hub.small:
            self.send(200, hub.small[found[1]], {})
        elif self.path.startswith("/cdn/"):
            content = hub.large[self.path.removeprefix("/cdn/")]
            start = re.fullmatch(r"bytes=(\d+)-", self.headers.get("Range") or "")
            first, headers = int(start[1]) if start else 0, {}
            if start:
                headers["Content-Range"] = f"bytes {first}-{len(content) - 1}/{len(content)}"
            self.send(206 if start else 200, content[first:], headers)
        else:
            self.send(404, b"", {})

    def send(self, status, content, headers):
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        cut = self.server.cut_after
        self.wfile.write(content[:cut])
        if cut is not None and len(content) > cut:
            self.close_connection = True

    def log_message(self, *_):
        pass


@pytest.fixture
def hub(monkeypatch):
    """The local hub; `HF_ENDPOINT` names it."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), Hub)
    server.large, server.small = {"model.safetensors": NET}, {"config.json": CONFIG}
    server.asked, server.elsewhere, server.cut_after = [], None, None
    server.url = f"http://127.0.0.1:{server.server_port}"
    server.contents = f"http://localhost:{server.server_port}"  # another host, as the hub has it
    monkeypatch.setenv("HF_ENDPOINT", server.url)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield server
    server.shutdown()
    server.server_close()
    thread.join()


def digest(content):
    return hashlib.sha256(content).hexdigest()


def checkpoint(**changes):
    base, name = f"hf://team/net@{REVISION}", "model.safetensors"
    net = {"name": name, "url": f"{base}/{name}", "sha256": digest(NET), "size": len(NET)}
    config = {"name": "config.json", "url": f"{base}/config.json", "sha256": digest(CONFIG)}
    given = {"name": "toy", "task": "detector", "kind": "transformers", "licence": "MIT"}
    return Checkpoint.model_validate({**given, "files": (net, config), **changes})


def single(url, content, **changes):
    file = {"name": "model.onnx", "url": url, "sha256": digest(content), **changes}
    return checkpoint(kind="onnx-yolox", files=(file,))


def quiet(*_):
    pass


def test_a_checkpoint_is_pulled_once_and_found_by_its_name(hub, tmp_path, monkeypatch):
    place = pull(checkpoint(), tmp_path, quiet)
    assert (place / "files" / "model.safetensors").read_bytes() == NET
    assert (place / "files" / "config.json").read_bytes() == CONFIG
    assert [path.name for path in tmp_path.iterdir()] == ["toy"]
    asked = len(hub.asked)
    assert (pull(checkpoint(), tmp_path, quiet), len(hub.asked)) == (place, asked)
    monkeypatch.setenv("WORLDPOSE_MODEL_FOLDER", str(tmp_path))
    before = weights_of(DetectionSettings(detector="model:toy"))
    assert len(before["model:toy"]) == 64
    assert "transformers" in before
    with pytest.raises(InputError, match="expected a checkpoint of task pose, found detector"):
        weights_of(DetectionSettings(pose="model:toy"))
    (place / "files" / "config.json").write_bytes(b"{}")
    assert weights_of(DetectionSettings(detector="model:toy")) != before


def test_an_interrupted_pull_shows_nothing_and_goes_on_where_it_stopped(hub, tmp_path):
    hub.cut_after = 1_500_000
    with pytest.raises(WorldposeError, match="resumes where it stopped"):
        pull(checkpoint(), tmp_path, quiet)
    assert not (tmp_path / "toy").exists()
    hub.cut_after = None
    hub.asked.clear()
    place = pull(checkpoint(), tmp_path, quiet)
    assert ("GET", "/cdn/model.safetensors", "bytes=1500000-") in hub.asked
    assert (place / "files" / "model.safetensors").read_bytes() == NET


def test_another_file_than_the_pinned_one_is_refused(hub, tmp_path):
    other = bytes(len(NET))
    hub.large["model.safetensors"] = other
    with pytest.raises(InputError, match=f"expected SHA-256 {digest(NET)}, found {digest(other)}"):
        pull(checkpoint(), tmp_path, quiet)
    assert not list(tmp_path.rglob("model.safetensors*"))
    assert not (tmp_path / "toy").exists()


def test_a_net_in_a_zip_archive_is_taken_out_and_checked(hub, tmp_path):
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as opened:
        opened.writestr("20230504/end2end.onnx", NET)
        opened.writestr("20230504/deploy.json", "{}")
    hub.large["net.zip"] = archive.getvalue()
    url = f"{hub.url}/cdn/net.zip"
    place = pull(single(url, NET, member="end2end.onnx", size=len(NET)), tmp_path, quiet)
    assert [path.name for path in (place / "files").iterdir()] == ["model.onnx"]
    assert (place / "files" / "model.onnx").read_bytes() == NET
    with pytest.raises(InputError, match=r"found 0 files other\.onnx"):
        pull(single(url, NET, member="other.onnx"), tmp_path / "2", quiet)
    with pytest.raises(InputError, match="expected SHA-256"):  # larger than pinned
        pull(single(url, NET, member="end2end.onnx", size=1000), tmp_path / "3", quiet)
    assert max(f.stat().st_size for f in (tmp_path / "3").rglob("*") if f.is_file()) < 10


def test_only_safe_addresses_are_followed(hub, tmp_path):
    for url in ("http://example.org/net", "file:///etc/passwd", "hf://team/net@main/f", "https://"):
        with pytest.raises(UsageError, match="https://HOST/PATH"):
            resolve_address(url)
    hub.elsewhere = "http://192.0.2.1/stolen"
    with pytest.raises(WorldposeError, match="stolen"):
        pull(checkpoint(), tmp_path, quiet)


def test_the_commands_list_pull_and_verify_checkpoints_of_a_users_file(hub, tmp_path, monkeypatch):
    folder, catalog = tmp_path / "cache", tmp_path / "mine.yaml"
    monkeypatch.setenv("WORLDPOSE_MODEL_FOLDER", str(folder))
    mine = single(f"{hub.url}/cdn/model.safetensors", NET).model_dump(exclude_none=True)
    catalog.write_text(json.dumps({"models": [mine]}))
    listed = json.loads(invoke("models", "list", "--json", "--catalog", catalog).output)
    pulled = {row["name"]: row["pulled"] for row in listed["models"]}
    assert pulled == {**dict.fromkeys(CATALOG, False), "toy": False}
    with pytest.raises(InputError, match="worldpose models pull toy"):
        load_detectors(DetectionSettings(detector="model:toy"))
    assert not hub.asked  # nothing is downloaded unasked
    answer = invoke("models", "pull", "toy", "--catalog", catalog)
    assert answer.exit_code == 0, answer.output
    assert "--set detection.detector=model:toy" in answer.output
    listed = json.loads(invoke("models", "list", "--json").output)
    assert {row["name"] for row in listed["models"] if row["pulled"]} == {"toy"}
    assert json.loads(invoke("models", "verify", "--json").output)["right"] == ["toy"]
    (folder / "toy" / "files" / "model.onnx").write_bytes(NET[:-1])
    answer = invoke("models", "verify", "toy")
    assert isinstance(answer.exception, WorldposeError)
    assert "toy: model.onnx" in str(answer.exception)
    assert not (folder / "toy").exists()
    answer = invoke("models", "pull", "yolox-smal")
    assert "Did you mean 'yolox-s'" in str(answer.exception)


@pytest.mark.parametrize("name", ["model:../toy", "model:.toy.partial", "model:absent"])
def test_a_model_name_is_never_a_path(name, tmp_path, monkeypatch):
    monkeypatch.setenv("WORLDPOSE_MODEL_FOLDER", str(tmp_path / "cache"))
    (tmp_path / "toy").mkdir()
    (tmp_path / "toy" / "model.json").write_text("{}")
    with pytest.raises(InputError, match="found none of this name"):
        weights_of(DetectionSettings(detector=name))


@pytest.mark.parametrize("entry", CATALOG.values(), ids=CATALOG)
def test_every_shipped_entry_names_a_safe_address_and_a_permissive_licence(entry):
    assert entry.licence == "Apache-2.0"
    for file in entry.files:
        assert resolve_address(file.url).startswith("https://")
        assert "/main/" not in file.url
