"""A generator is saved, read, and sent to the Hugging Face hub as the hub's own models are."""

import inspect
import sys
from pathlib import Path
from types import SimpleNamespace

import huggingface_hub
import pytest
import torch

from lidargrit.core.errors import CheckpointError, ConfigError
from lidargrit.generation.generator import Generator
from lidargrit.systems.lidargrit.system import LidarGrit
from lidargrit.systems.marginal.system import Marginal
from test_publishing import marginal
from tiny_runs import contents

OF_THE_HUB = huggingface_hub.ModelHubMixin
OURS = {"card", "bits"}


@pytest.mark.parametrize("name", ["from_pretrained", "save_pretrained", "push_to_hub"])
def test_signatures_are_those_of_the_hubs_mixin(name):
    ours, theirs = (inspect.signature(getattr(cls, name)).parameters for cls in (Marginal, OF_THE_HUB))
    pushed = inspect.signature(OF_THE_HUB.push_to_hub).parameters  # which theirs takes as further keywords
    for argument in ours.values():
        if argument.name not in OURS:
            theirs_of_name = theirs.get(argument.name) or pushed[argument.name]
            assert argument.kind == theirs_of_name.kind
            if argument.name not in ("commit_message", "save_directory", "pretrained_model_name_or_path"):
                assert argument.default == theirs_of_name.default
    first = 1 if name == "from_pretrained" else 2  # with self
    assert list(ours)[:first] == list(theirs)[:first]


def test_saved_and_read_in_the_hubs_way(tmp_path):
    model = marginal()
    assert model.save_pretrained(str(tmp_path / "model"), card="# A model\n", bits=32) is None
    assert set(contents(tmp_path / "model")) == {"README.md", "config.json", "model.safetensors"}
    again = Marginal.from_pretrained(str(tmp_path / "model"))
    assert all(torch.equal(of, again.state_dict()[name]) for name, of in model.state_dict().items())
    assert isinstance(Generator.from_pretrained(tmp_path / "model"), Marginal)
    with pytest.raises(CheckpointError, match="holds a generator 'marginal'; wanted a generator 'lidargrit'"):
        LidarGrit.from_pretrained(tmp_path / "model")
    model.save_pretrained(tmp_path / "bare")
    assert set(contents(tmp_path / "bare")) == {"config.json", "model.safetensors"}


def test_a_model_in_the_hubs_cache_is_read_without_a_network(tmp_path):
    commit = "a" * 40
    repository = tmp_path / "cache" / "models--some-one--model"
    marginal().save_pretrained(repository / "snapshots" / commit)
    (repository / "refs").mkdir()
    (repository / "refs" / "main").write_text(commit)
    asked = {"cache_dir": tmp_path / "cache", "local_files_only": True}
    assert isinstance(Generator.from_pretrained("some-one/model", **asked), Marginal)
    with pytest.raises(CheckpointError, match=r"some-one/other, which cannot be fetched \(LocalEntryNotFoundError"):
        Generator.from_pretrained("some-one/other", **asked)


def test_a_name_that_is_no_folder_is_asked_of_the_hub(tmp_path, monkeypatch):
    marginal().save_pretrained(tmp_path / "fetched")
    asked = []

    def snapshot_download(name, **options):
        asked.append((name, options["revision"], options["allow_patterns"]))
        if name == "nobody/nothing":
            raise RuntimeError("404\nlong story")
        return str(tmp_path / "fetched")

    monkeypatch.setattr(huggingface_hub, "snapshot_download", snapshot_download)
    assert isinstance(Generator.from_pretrained("some-one/model.1", revision="v1"), Marginal)
    assert asked == [("some-one/model.1", "v1", ["*.json", "model.safetensors"])]
    with pytest.raises(ConfigError, match=r"^got revision='v1' of .*fetched, which is a folder here; wanted "):
        Generator.from_pretrained(tmp_path / "fetched", revision="v1")
    with pytest.raises(CheckpointError, match=r"which cannot be fetched \(RuntimeError: 404\);"):
        Generator.from_pretrained("nobody/nothing")
    with pytest.raises(CheckpointError, match="runs/mine/gone, which is no folder"):
        Generator.from_pretrained("runs/mine/gone")
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)  # as if it were not installed
    for action in (Generator.from_pretrained, marginal().push_to_hub):
        with pytest.raises((CheckpointError, ConfigError), match=r"pip install 'lidargrit\[hub\]'"):
            action("some-one/model")


def test_a_model_is_uploaded_in_8_bits(tmp_path, monkeypatch):
    sent = {}

    class Api:
        def __init__(self, token):
            sent["token"] = token

        def create_repo(self, repo_id, **options):
            sent["made"] = (repo_id, options)

        def create_branch(self, repo_id, **options):
            sent["branch"] = options["branch"]

        def upload_folder(self, **options):
            sent["files"] = {path.name: path.stat().st_size for path in Path(options["folder_path"]).iterdir()}
            sent["upload"] = options
            return SimpleNamespace(commit_url="https://hub/commit")

    uploads = inspect.signature(huggingface_hub.HfApi.upload_folder).parameters
    for name, wanted in (("create_repo", {"repo_id", "private", "exist_ok"}), ("create_branch", {"repo_id", "branch"})):
        assert wanted <= set(inspect.signature(getattr(huggingface_hub.HfApi, name)).parameters)
    monkeypatch.setattr(huggingface_hub, "HfApi", Api)
    model = LidarGrit(LidarGrit.smallest_config(sensor := marginal().sensor), sensor)
    url = model.push_to_hub("me/mine", card="# Mine\n", private=True, token="t", branch="tried", create_pr=True)
    assert url == "https://hub/commit"
    assert (sent["token"], sent["branch"], sent["made"]) == (
        "t",
        "tried",
        ("me/mine", {"private": True, "exist_ok": True}),
    )
    assert set(sent["files"]) == {"README.md", "config.json", "model.safetensors"}
    assert set(sent["upload"]) <= set(uploads)
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "checkpoint.safetensors").write_text("an owner's, as that of a run")
    assert model.save_pretrained(tmp_path / "here", repo_id="me/mine", push_to_hub=True) == url
    assert set(sent["files"]) == {"config.json", "model.safetensors"}
    model.save(tmp_path / "whole")
    whole = (tmp_path / "whole" / "model.safetensors").stat().st_size
    assert sent["files"]["model.safetensors"] == (tmp_path / "here" / "model.safetensors").stat().st_size < whole / 2

    def refuses(self, **options):
        raise RuntimeError("403 Forbidden")

    monkeypatch.setattr(Api, "upload_folder", refuses)
    with pytest.raises(ConfigError, match=r"me/mine, to which nothing was uploaded \(RuntimeError: 403 Forbidden\)"):
        model.push_to_hub("me/mine")
