"""Trained models to take home: those that come with the package, and repositories of a model hub.

A model is a folder with `model.safetensors`, `config.json` and a card, `README.md`. The hub is that
of Hugging Face; from a repository nothing but these three files is taken, and nothing is unpickled.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from offbeat.errors import InputError, OffbeatError, one_of, require
from offbeat.files import write_text
from offbeat.models.checkpoint import CONFIG, TENSORS, load_model, save_model
from offbeat.tables import markdown

if TYPE_CHECKING:
    from offbeat.models.base import BaseModel

CARD = "README.md"
PREFIX = "offbeat/"
"""What the names of models that come with the package begin with."""

_TRAINED = Path(__file__).parents[1] / "trained"
_REPOSITORY = re.compile(r"\w[\w.-]*/\w[\w.-]*")


def trained_models() -> dict[str, str]:
    """Names of the trained models that come with the package, and what each is, in one line."""
    found = {}
    for folder in sorted(_TRAINED.iterdir()):
        if (folder / CONFIG).is_file():
            lines = (folder / CARD).read_text(encoding="utf-8").splitlines()
            heading = next(i for i, line in enumerate(lines) if line.startswith("# "))
            about = lines[heading + 2]
            found[PREFIX + folder.name] = about
    return found


def trained_folder(name: str) -> Path:
    """The folder of a model that comes with the package.

    Raises:
        InputError: there is none of this name; the message lists those there are.
    """
    known = {folder.name for folder in _TRAINED.iterdir() if (folder / CONFIG).is_file()}
    one_of("trained model", name, (PREFIX + each for each in known))
    return _TRAINED / name.removeprefix(PREFIX)


def from_pretrained(name: str | Path, *, revision: str | None = None) -> Any:
    """Reads a model from a folder, from the package, or from the hub.

    Args:
        name: a folder; or `offbeat/NAME`, as `trained_models` lists; or `OWNER/NAME` of the hub.
        revision: branch, tag or commit of the hub.

    Returns:
        As `load_model`.

    Raises:
        FileFormatError: as `load_model`.
        InputError: the name is none of these, or the hub has no such repository.
        MissingExtraError: huggingface-hub is not installed, for a name of the hub.
        OffbeatError: the hub is out of reach.
    """
    if Path(name).is_dir() or str(name).startswith(PREFIX):
        return load_model(name)
    repository = _checked(name)
    hub = require("huggingface_hub", "hub")
    try:
        folder = hub.snapshot_download(
            repository, revision=revision, allow_patterns=[CONFIG, TENSORS, CARD]
        )
    except hub.errors.RepositoryNotFoundError:
        raise InputError(
            f"the hub has no repository {repository!r}, or it is private; check the name, or log in"
        ) from None
    except (hub.errors.HfHubHTTPError, hub.errors.LocalEntryNotFoundError, OSError) as error:
        raise OffbeatError(
            f"{repository} cannot be downloaded ({_line(error)}); check the connection, or give a "
            "folder"
        ) from None
    return load_model(folder)


def save_pretrained(model: BaseModel, path: str | Path, *, card: str | None = None) -> None:
    """Writes a model with its card to a folder.

    Args:
        model: trained.
        path: the folder; its model, if any, is replaced.
        card: Markdown; by default what is known from the model itself.
    """
    save_model(model, path)
    write_text(Path(path) / CARD, card or card_of(model))


def push_to_hub(
    model: BaseModel,
    repository: str,
    *,
    card: str | None = None,
    private: bool = False,
    token: str | None = None,
) -> str:
    """Uploads a model and its card to the hub; makes the repository where there is none.

    Args:
        model: trained.
        repository: `OWNER/NAME`.
        card: as of `save_pretrained`.
        private: of a new repository.
        token: of the hub; by default that of its own login.

    Returns:
        The address of the commit.

    Raises:
        InputError: the name is none of a repository.
        MissingExtraError: huggingface-hub is not installed.
        OffbeatError: the hub refuses, or is out of reach.
    """
    import tempfile

    _checked(repository)
    hub = require("huggingface_hub", "hub")
    with tempfile.TemporaryDirectory(prefix="offbeat-") as folder:
        save_pretrained(model, Path(folder) / "model", card=card)
        try:
            hub.create_repo(repository, private=private, token=token, exist_ok=True)
            done = hub.upload_folder(
                repo_id=repository,
                folder_path=str(Path(folder) / "model"),
                commit_message=f"Upload {model.name}",
                token=token,
            )
        except (hub.errors.HfHubHTTPError, OSError) as error:
            raise OffbeatError(
                f"{repository} was not uploaded ({_line(error)}); check connection and login"
            ) from None
    return str(done.commit_url)


def card_of(
    model: BaseModel, *, name: str = "", about: str = "", sections: Mapping[str, str] | None = None
) -> str:
    """A model card in Markdown.

    Args:
        model: whose channels and size the card shows.
        name: of the folder or repository, in the heading and the example.
        about: one line; by default what the model is made of.
        sections: further headings with their text, such as data, scores and licence.
    """
    count = sum(p.numel() for p in model.parameters())
    about = about or f"{model.name}, {count:,} parameters, {len(model.names)} channels."
    rows = zip(model.names, model.units, model.roles, strict=True)
    parts = [
        "---\nlibrary_name: offbeat\ntags: [irregular-time-series, robotics]\n---",
        f"# {name or model.name}",
        about,
        f'```python\nimport offbeat as ob\n\nmodel = ob.load_model("{name or "FOLDER"}")\n```',
        *(f"## {heading}\n\n{text}" for heading, text in (sections or {}).items()),
        "## Channels",
        markdown(("channel", "unit", "role"), rows),
    ]
    return "\n\n".join(parts) + "\n"


def _checked(name: str | Path) -> str:
    if not _REPOSITORY.fullmatch(str(name)):
        raise InputError(
            f"{str(name)[:80]!r} is no folder, and no OWNER/NAME of a repository; give one of them"
        )
    return str(name)


def _line(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())[:150]}"
