"""What every engine needs to know of a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import yaml

from proto.config import Config

MADE_BY: Final = (
    "Written by `python -m deploy.manifests {}`; change the configuration, not this file."
)

DRAIN_S: Final = 60
"""An actor whose outbox is lost with it waits so long for receipts before it ends."""


@dataclass(frozen=True)
class Plan:
    """A run whose files are to be written.

    Attributes:
        config: its configuration.
        config_text: the text of the configuration's file.
        actors: number of actors by simulator.
        out: folder of the files, as it is named in them.
        python: the Python that runs vmdnn on the machines.
    """

    config: Config
    config_text: str
    actors: Mapping[str, int]
    out: Path
    python: str

    @property
    def vmdnn(self) -> str:
        """The command `vmdnn` beside that Python."""
        return str(Path(self.python).with_name("vmdnn"))

    @property
    def link(self) -> str:
        """How the hub is reached, such as `tcp` or `tls`."""
        return self.config.hub.endpoint.partition("/")[0]

    @property
    def port(self) -> int:
        """Port of the hub."""
        return int(self.config.hub.endpoint.rpartition(":")[2])

    @property
    def everywhere(self) -> str:
        """Endpoint at which the hub listens for other machines."""
        return f"{self.link}/0.0.0.0:{self.port}"

    @property
    def insecure(self) -> bool:
        """Whether other machines reach the hub without certificates."""
        return self.link == "tcp"

    @property
    def admission(self) -> tuple[str, ...]:
        """Arguments of a process that must be told that links to the hub are not protected."""
        return ("--set", "hub.insecure=true") if self.insecure else ()


class _Dumper(yaml.SafeDumper):
    """Writes YAML without anchors, and long texts line by line."""

    def ignore_aliases(self, _data: Any) -> bool:
        return True


def _text(dumper: _Dumper, text: str) -> yaml.ScalarNode:
    style = "|" if "\n" in text else None
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style=style)


_Dumper.add_representer(str, _text)


def yaml_text(engine: str, documents: Sequence[Mapping[str, Any]]) -> str:
    """Return the text of a file of YAML documents, with the line that says what wrote it."""
    texts = [yaml.dump(each, Dumper=_Dumper, sort_keys=False, width=100) for each in documents]
    return f"# {MADE_BY.format(engine)}\n" + "---\n".join(texts)
