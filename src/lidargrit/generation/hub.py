"""Files of a saved network ⇄ a repository of the Hugging Face hub, by the hub's own client, which is an extra."""

import importlib
import re
from pathlib import Path
from types import ModuleType

from lidargrit.core.errors import CheckpointError, ConfigError, kind_and_words
from lidargrit.data.run_folder import WEIGHTS_FILE, named_folder

_WANTED = "a run's folder, or USER/REPOSITORY on the Hugging Face hub"


def located(
    name: str | Path,
    revision: str | None,
    force_download: bool,
    token: str | bool | None,
    cache_dir: str | Path | None,
    local_files_only: bool,
) -> Path:
    """Return the folder of a saved network: one that is here, or else that of a repository's downloaded files.

    The hub's client keeps them in its cache, and reads them there without a network.

    Args:
        name: folder of a run or of a published generator, or USER/REPOSITORY.
        revision: branch, tag or commit; the main branch if not given.
        force_download: whether to fetch files that are in the cache.
        token: the user's token; the one that the client has saved if not given.
        cache_dir: folder of the cache; the client's own if not given.
        local_files_only: whether to read the cache and ask nobody.
    """
    here = named_folder(name)
    if here.is_dir():
        if revision is not None:
            got, wanted = f"revision={revision!r} of {name}, which is a folder here", "a repository, or no revision"
            raise ConfigError(got, wanted, "leave it out, or start in another folder")
        return here
    hub = _client(str(name), CheckpointError)
    try:
        path = hub.snapshot_download(
            str(name),
            revision=revision,
            force_download=force_download,
            token=token,
            cache_dir=cache_dir,
            local_files_only=local_files_only,
            allow_patterns=["*.json", WEIGHTS_FILE],
        )
    except Exception as error:  # its client has a dozen kinds, from a wrong name to a broken line, and changes them
        raise CheckpointError(
            f"{name}, which cannot be fetched ({kind_and_words(error)})", _WANTED, "check the name"
        ) from None
    return Path(path)


def upload(
    folder: Path,
    repo_id: str,
    *,
    commit_message: str,
    private: bool | None,
    token: str | None,
    branch: str | None,
    create_pr: bool | None,
) -> str:
    """Upload the files of a folder, and return the address of the commit; the repository is made if it is missing."""
    hub = _client(repo_id, ConfigError)
    try:
        api = hub.HfApi(token=token)
        api.create_repo(repo_id, private=private, exist_ok=True)
        if branch is not None:
            api.create_branch(repo_id, branch=branch, exist_ok=True)
        commit = api.upload_folder(
            repo_id=repo_id, folder_path=folder, commit_message=commit_message, revision=branch, create_pr=create_pr
        )
    except Exception as error:  # as above
        got, cure = f"{repo_id}, to which nothing was uploaded ({kind_and_words(error)})", "log in with: hf auth login"
        raise ConfigError(got, "a repository that you may write to", cure) from None
    return str(commit.commit_url)


def _client(name: str, error: type[CheckpointError] | type[ConfigError]) -> ModuleType:
    if not re.fullmatch(r"[\w.-]+/[\w.-]+", name):
        raise error(f"{name}, which is no folder", _WANTED, "check the name")
    try:
        return importlib.import_module("huggingface_hub")
    except ImportError:
        cure = "install its client: pip install 'lidargrit[hub]'"
        raise error(f"{name}, a repository on the hub", "the hub's client", cure) from None
